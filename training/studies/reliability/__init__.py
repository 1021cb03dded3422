"""Reliability: what happens to the whole under input and treatment that nobody means well.

``parts`` says what a part of the campaign is, ``command`` is the study, ``page`` its page; ``files`` is the part
that hands mutated and hostile files to every reader.
"""

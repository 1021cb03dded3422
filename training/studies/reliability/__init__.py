"""Reliability: what happens to the whole under input and treatment that nobody means well.

``parts`` says what a part of the campaign is, ``command`` is the study, ``page`` its page; ``files`` is the part
that hands mutated and hostile files to every reader, ``steps`` steps every environment, ``kills`` kills commands,
``places`` runs them where they cannot write, and ``soak`` has environments live for hours.
"""

"""The part ``kills``: commands killed at random moments and run again, until they have come to their end.

``commands`` says which, ``results`` reads what they leave, ``killing`` starts and kills, ``part`` is the part.
"""

"""Kills: commands killed at random moments and run again, until they have come to their end.

``commands`` says which, ``killing`` starts and kills, ``results`` reads what they leave, ``alone`` is a run that
nobody disturbs, ``part`` is the campaign's part.
"""

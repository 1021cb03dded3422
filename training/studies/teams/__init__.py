"""Questions asked of several robots that map one building together.

``filters`` compares one filter for all of them with a filter each.
"""

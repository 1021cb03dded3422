"""Questions asked of several robots that map one building together.

``filters`` compares one filter for all of them with a filter each; ``merging`` asks whether the maps of two are
merged rightly that know nothing of each other's start; ``cost`` is what a step takes against the number of robots.
"""

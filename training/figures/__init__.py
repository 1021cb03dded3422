"""Figures: statistics with intervals, line charts, and the style of our pages."""

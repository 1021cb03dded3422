"""The part ``soak``: environments that live for hours, reset over mixed rooms, and what memory and handles do."""

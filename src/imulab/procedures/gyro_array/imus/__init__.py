"""Whole IMUs on one board: where each sits, how it is turned, how late it answers."""

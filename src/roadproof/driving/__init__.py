"""Drives: made, kept, compared, judged."""

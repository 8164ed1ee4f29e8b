"""A regression gate: one controller against stored, random and fresh patterns, judged by a plan's limits."""

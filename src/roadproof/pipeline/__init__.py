"""The whole loop for one scenario: its stages, what each may spend, what it took."""

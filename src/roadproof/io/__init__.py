"""The one way to the disk and back: names that stay in their folder, whole files or none, and a guard at every door."""

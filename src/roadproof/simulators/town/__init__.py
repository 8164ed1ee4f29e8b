"""The embedded town: roads from OpenDRIVE, a software renderer and vehicle physics on one CPU core."""

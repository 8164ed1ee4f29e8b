"""roadproof: finds the paint on a road that makes a camera-driven controller leave its lane, in simulation."""

__version__ = "0.1.0"

"""The recorded world: driving in calibrated recordings, many cars at once and differentiably, or as a simulator."""

from roadproof.recorded.poses import placed as placed
from roadproof.recorded.simulator import RecordedSimulator as RecordedSimulator
from roadproof.recorded.vehicle import Vehicle as Vehicle
from roadproof.recorded.world import BiasedStart as BiasedStart
from roadproof.recorded.world import RecordedWorld as RecordedWorld

"""Recording a driver: the clean drive, and perturbed ones, past the canvas."""

from roadproof.drives.folder import Drive as Drive
from roadproof.drives.folder import Drives as Drives
from roadproof.drives.record import record as record
from roadproof.drives.record import record_along as record_along
from roadproof.drives.trajectories import Scheme as Scheme
from roadproof.drives.trajectories import SteeringNoise as SteeringNoise
from roadproof.drives.trajectories import Swerve as Swerve
from roadproof.drives.trajectories import Trajectories as Trajectories
from roadproof.drives.trajectories import Window as Window

"""Attacks: the search for the pattern that moves a controller most."""

from roadproof.attacks.attack import attack as attack
from roadproof.attacks.attack import kept_attack as kept_attack
from roadproof.attacks.checks import Check as Check
from roadproof.attacks.gradopt import Heat as Heat
from roadproof.attacks.gradopt import Schedule as Schedule
from roadproof.attacks.objective import GRADIENTS as GRADIENTS
from roadproof.attacks.objective import OBJECTIVES as OBJECTIVES
from roadproof.attacks.objective import Objective as Objective
from roadproof.attacks.objective import PathDeviation as PathDeviation
from roadproof.attacks.objective import SteeringShift as SteeringShift
from roadproof.attacks.result import AttackResult as AttackResult
from roadproof.attacks.result import Candidate as Candidate
from roadproof.attacks.result import Cost as Cost
from roadproof.attacks.show import ShownDrive as ShownDrive
from roadproof.attacks.show import show_pattern as show_pattern
from roadproof.attacks.surrogate import Surrogate as Surrogate

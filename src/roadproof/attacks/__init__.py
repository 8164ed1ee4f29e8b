"""Attacks: the search for the pattern that moves a controller most."""

from roadproof.attacks.attack import attack as attack
from roadproof.attacks.attack import kept_attack as kept_attack
from roadproof.attacks.blackbox import CMAES as CMAES
from roadproof.attacks.blackbox import TPE as TPE
from roadproof.attacks.blackbox import BayesianOptimisation as BayesianOptimisation
from roadproof.attacks.blackbox import BlackBox as BlackBox
from roadproof.attacks.blackbox import GaussianProcess as GaussianProcess
from roadproof.attacks.blackbox import RandomSearch as RandomSearch
from roadproof.attacks.checks import Check as Check
from roadproof.attacks.groups import parse_groups as parse_groups
from roadproof.attacks.method import Method as Method
from roadproof.attacks.methods import METHODS as METHODS
from roadproof.attacks.methods import GradOpt as GradOpt
from roadproof.attacks.methods import Published as Published
from roadproof.attacks.methods import method_of as method_of
from roadproof.attacks.objective import OBJECTIVES as OBJECTIVES
from roadproof.attacks.objective import Objective as Objective
from roadproof.attacks.objective import PathDeviation as PathDeviation
from roadproof.attacks.objective import SteeringShift as SteeringShift
from roadproof.attacks.result import AttackResult as AttackResult
from roadproof.attacks.result import Candidate as Candidate
from roadproof.attacks.result import Cost as Cost
from roadproof.attacks.show import ShownDrive as ShownDrive
from roadproof.attacks.show import show_pattern as show_pattern
from roadproof.attacks.site import site_of as site_of
from roadproof.attacks.surrogate import Surrogate as Surrogate

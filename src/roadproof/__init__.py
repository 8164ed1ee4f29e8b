"""roadproof: finds the paint on a road that makes a camera-driven controller leave its lane, in simulation.

Every public name is here and loaded on first use, so that importing roadproof costs nothing.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from roadproof.attacks import CMAES as CMAES
    from roadproof.attacks import TPE as TPE
    from roadproof.attacks import AttackResult as AttackResult
    from roadproof.attacks import BayesianOptimisation as BayesianOptimisation
    from roadproof.attacks import GradOpt as GradOpt
    from roadproof.attacks import PathDeviation as PathDeviation
    from roadproof.attacks import Published as Published
    from roadproof.attacks import SteeringShift as SteeringShift
    from roadproof.attacks import attack as attack
    from roadproof.attacks import show_pattern as show_pattern
    from roadproof.attacks.groups import Group as Group
    from roadproof.attacks.groups import parse_groups as parse_groups
    from roadproof.compositing import CanvasView as CanvasView
    from roadproof.compositing import composite as composite
    from roadproof.compositing import view_canvas as view_canvas
    from roadproof.controllers import Controller as Controller
    from roadproof.controllers import CruiseControl as CruiseControl
    from roadproof.controllers import check_controller as check_controller
    from roadproof.controllers import load_controller as load_controller
    from roadproof.coverage import Shape as Shape
    from roadproof.datatypes import Control as Control
    from roadproof.datatypes import Weather as Weather
    from roadproof.driving.evaluate import evaluate as evaluate
    from roadproof.driving.evaluation import Evaluation as Evaluation
    from roadproof.errors import RoadproofError as RoadproofError
    from roadproof.geometry import CameraModel as CameraModel
    from roadproof.geometry import CanvasPlacement as CanvasPlacement
    from roadproof.geometry import CropResize as CropResize
    from roadproof.geometry import homography_from_points as homography_from_points
    from roadproof.geometry import homography_from_pose as homography_from_pose
    from roadproof.hardening.harden import harden as harden
    from roadproof.patterns import Pattern as Pattern
    from roadproof.patterns import load_pattern as load_pattern
    from roadproof.patterns import raster as raster
    from roadproof.patterns import save_pattern as save_pattern
    from roadproof.photometry import AffineResponse as AffineResponse
    from roadproof.photometry import ColourTransform as ColourTransform
    from roadproof.photometry import fit_colour as fit_colour
    from roadproof.pipeline.budget import PUBLISHED as PUBLISHED
    from roadproof.pipeline.budget import QUICK as QUICK
    from roadproof.pipeline.budget import STEERING as STEERING
    from roadproof.pipeline.budget import Budget as Budget
    from roadproof.pipeline.stress_test import StressTest as StressTest
    from roadproof.pipeline.stress_test import stress_test as stress_test
    from roadproof.recorded import RecordedSimulator as RecordedSimulator
    from roadproof.recorded import Vehicle as Vehicle
    from roadproof.recorded.poses import placed as placed
    from roadproof.recordings import Push as Push
    from roadproof.recordings import Recording as Recording
    from roadproof.recordings import RecordingSet as RecordingSet
    from roadproof.recordings import load_recordings as load_recordings
    from roadproof.recordings import save_recordings as save_recordings
    from roadproof.report.page import write_report as write_report
    from roadproof.scenarios import Scenario as Scenario
    from roadproof.scenarios import builtin_scenarios as builtin_scenarios
    from roadproof.scenarios import find_scenario as find_scenario
    from roadproof.search_space import SearchSpace as SearchSpace
    from roadproof.simulators.town.simulator import TownSimulator as TownSimulator

__version__ = "0.1.0"

_ROOMS = {
    "attacks": (
        "AttackResult",
        "BayesianOptimisation",
        "CMAES",
        "GradOpt",
        "PathDeviation",
        "Published",
        "SteeringShift",
        "TPE",
        "attack",
        "show_pattern",
    ),
    "attacks.groups": ("Group", "parse_groups"),
    "compositing": ("CanvasView", "composite", "view_canvas"),
    "controllers": ("Controller", "CruiseControl", "check_controller", "load_controller"),
    "coverage": ("Shape",),
    "datatypes": ("Control", "Weather"),
    "driving.evaluate": ("evaluate",),
    "driving.evaluation": ("Evaluation",),
    "errors": ("RoadproofError",),
    "geometry": ("CameraModel", "CanvasPlacement", "CropResize", "homography_from_points", "homography_from_pose"),
    "hardening.harden": ("harden",),
    "patterns": ("Pattern", "load_pattern", "raster", "save_pattern"),
    "photometry": ("AffineResponse", "ColourTransform", "fit_colour"),
    "pipeline.budget": ("Budget", "PUBLISHED", "QUICK", "STEERING"),
    "pipeline.stress_test": ("StressTest", "stress_test"),
    "recorded": ("RecordedSimulator", "Vehicle"),
    "recorded.poses": ("placed",),
    "recordings": ("Push", "Recording", "RecordingSet", "load_recordings", "save_recordings"),
    "report.page": ("write_report",),
    "scenarios": ("Scenario", "builtin_scenarios", "find_scenario"),
    "search_space": ("SearchSpace",),
    "simulators.town.simulator": ("TownSimulator",),
}
_ROOM_OF = {name: room for room, names in _ROOMS.items() for name in names}


def __getattr__(name: str) -> object:
    if name not in _ROOM_OF:
        raise AttributeError(f"module 'roadproof' has no attribute {name!r}")
    return getattr(import_module(f"roadproof.{_ROOM_OF[name]}"), name)


def __dir__() -> list[str]:
    return sorted([*globals(), *_ROOM_OF])

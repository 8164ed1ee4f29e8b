"""What a pattern is worth in a simulator: its effect in one whole drive, closed loop, without gradients.

    attack(InSimulator(simulator, scenario), controller, space, method=CMAES(calls=140), objective=PathDeviation())

    steering shift  |∑_{f<F'} (steer_f − clean steer_f)| with F' = 80 % of the clean drive's frames; what the authors
                    gave their Bayesian optimisation. A drive that ends before adds nothing after its end.
    path deviation  the paper's deviation in metres, which evaluations report (`driving.deviation`).

Both are taken of every drive; the objective asked for is the value.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import torch

from roadproof.attacks.groups import Direction, Group, Points, Values
from roadproof.attacks.objective import Objective, PathDeviation, SteeringShift
from roadproof.controllers import Controller
from roadproof.datatypes import Observation, Weather
from roadproof.driving.deviation import canvas_missed, passage, passage_deviation_m, path_of, sees_canvas
from roadproof.driving.drive_store import Episodes
from roadproof.driving.episode import Episode
from roadproof.driving.rollout import Driver, rollout
from roadproof.errors import RoadproofError
from roadproof.geometry import CanvasPlacement
from roadproof.io.files import AnyPath, as_path
from roadproof.io.identity import digest, stated
from roadproof.io.records import Form, RecordFile
from roadproof.patterns import Pattern, raster
from roadproof.scenarios import Scenario
from roadproof.search_space import SearchSpace
from roadproof.simulators.protocol import PatternImage, Simulator

SHARE = 0.8
"""Of the clean drive's frames, over which the authors sum the steering."""


@dataclass(frozen=True, slots=True)
class Effect:
    """What a pattern did in one drive in a simulator.

    Args:
        steering: absolute value of the summed steering shift, in steer units.
        deviation: the paper's deviation between the clean and the painted path, metres.
    """

    steering: float
    deviation: float


@dataclass(frozen=True, slots=True, eq=False)
class InSimulator:
    """A stretch of road in a simulator, always driven in the same conditions and without traffic.

    Args:
        simulator: an open simulator.
        scenario: scenario with the stretch of road to drive.
        weather: weather of all drives, clear noon by default.
        seed: seed of all drives, 0 by default.
        keep: file that keeps the effect of every drive, so that a known pattern is not driven again; it belongs to one
            scenario, controller, weather, seed and simulator, and refuses others. None keeps nothing.
    """

    simulator: Simulator
    scenario: Scenario
    weather: Weather = Weather.CLEAR_NOON
    seed: int = 0
    keep: AnyPath | None = None


class DrivenMeasure:
    """The effect of patterns in a simulator, one drive each, to whichever side the car gives way.

    Args:
        place: simulator, scenario and conditions; the clean drive is made at once.
        driver: a controller, or a function that is given the simulator after each reset.
        objective: `SteeringShift()` or `PathDeviation()`; their fields concern recordings and are not used here.

    Raises:
        RoadproofError: another objective is asked for, the file of drives is damaged, the clean `rollout` fails, or it
            never comes to the canvas.
    """

    groups = (Group((), Direction.EITHER),)
    device = torch.device("cpu")

    def __init__(self, place: InSimulator, driver: Controller | Driver[Simulator], objective: Objective) -> None:
        if not isinstance(objective, SteeringShift | PathDeviation) or objective.variation is not None:
            raise RoadproofError(
                f"a drive in a simulator gives the steering shift and the path deviation, not the {objective.name}"
            )
        self._deviates = isinstance(objective, PathDeviation)
        self._place, self._known = place, dict[str, Effect]()
        self._keep = None if place.keep is None else as_path(place.keep)
        paints: dict[str, PatternImage] = {}
        parts = dict(Episodes.of(place.simulator, driver, place.scenario, paints, Path()).parts)
        # Drives are as costly in the next version; what another one answers otherwise shows in the clean drive.
        parts.pop("version")
        self._conditions = digest(stated([parts, place.weather, place.seed]))
        self.calls, self.frames_evaluated = 0, 0

        def drive(pattern: PatternImage | None, until: Callable[[Observation], bool] | None) -> Episode:
            simulator, scenario, weather, seed = place.simulator, place.scenario, place.weather, place.seed
            made = rollout(simulator, driver, scenario, weather=weather, pattern=pattern, seed=seed, until=until)
            self.calls, self.frames_evaluated = self.calls + 1, self.frames_evaluated + made.steer.size
            return made

        self._drive = drive
        self.clean = drive(None, None)
        if not sees_canvas(path_of(self.clean), place.scenario.canvas):
            raise canvas_missed(place.scenario.name)
        if self._keep is not None and self._keep.exists():
            kept = _FILE.read(self._keep)
            if (kept.clean, kept.conditions) != (self._told(), self._conditions):
                raise RoadproofError(
                    f"{self._keep} holds drives over patterns by another controller, or elsewhere: its clean drive, "
                    "scenario, canvas, weather, seed or simulator is another; give another file, or remove it"
                )
            self._known = kept.drives

    def values(self, space: SearchSpace, unit: Points) -> Values:
        """Values of R points of a search space; each takes one drive, unless its pattern was driven over before."""
        effects = [self.effect(space.pattern(point)) for point in unit[0]]
        found = [each.deviation if self._deviates else each.steering for each in effects]
        return torch.tensor([found], dtype=torch.float64)

    def effect(self, pattern: Pattern) -> Effect:
        """The effect of a pattern, from one drive over it or from the file of drives."""
        paint = raster(pattern)
        key = digest(paint)[:24]
        if key not in self._known:
            self._known[key] = effect_of(self.clean, self._drive(paint, self._enough()), self._place.scenario.canvas)
            if self._keep is not None:
                _FILE.write(self._keep, _Kept(self._known, self._told(), self._conditions))
        return self._known[key]

    def fingerprint(self) -> str:
        """A digest of the clean drive, its conditions and the objective, which tells this measure from others."""
        return f"{self._told()} {self._conditions} {self._deviates}"

    def _told(self) -> str:
        """A digest of the clean drive."""
        return digest(path_of(self.clean), self.clean.steer)

    def _enough(self) -> Callable[[Observation], bool]:
        """A condition that ends a drive after the last frame that either effect needs, for a car off the road."""
        canvas = self._place.scenario.canvas
        last = max(_counted_frames(self.clean), passage(path_of(self.clean), canvas).stop)
        seen = 0

        def enough(_: Observation) -> bool:
            nonlocal seen
            seen += 1
            return seen > last

        return enough


def effect_of(clean: Episode, painted: Episode, canvas: CanvasPlacement) -> Effect:
    """The effect of the paint, from two drives that differ in the paint alone."""
    frames = min(_counted_frames(clean), painted.steer.size)
    shift = painted.steer[:frames] - clean.steer[:frames]
    return Effect(steering=abs(float(shift.sum())), deviation=passage_deviation_m(clean, painted, canvas))


def _counted_frames(clean: Episode) -> int:
    return int(SHARE * clean.steer.size)


@dataclass(frozen=True, slots=True)
class _Kept:
    """The file of effects, each by a digest of its paint, with digests of the clean drive and of its conditions."""

    drives: dict[str, Effect]
    clean: str
    conditions: str


_ROWS = Form(
    tuple[tuple[str, float, float], ...],
    lambda known: [(key, each.steering, each.deviation) for key, each in known.items()],
    lambda rows: {key: Effect(*numbers) for key, *numbers in rows},
)
_FILE = RecordFile(
    kind=_Kept,
    name="roadproof-driven",
    error=RoadproofError,
    remedy="remove it",
    forms={"drives": _ROWS},
    notes={"kind": "closed loop"},
)

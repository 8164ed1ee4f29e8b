"""What a black-box search makes large: the effect of a pattern in one whole drive, closed loop.

    steering      |∑_{f<F'} (steer_f − clean steer_f)| with F' = 80 % of the clean drive's frames; what the authors
                  gave their Bayesian optimisation. A drive that ends before adds nothing after its end.
    deviation     the paper's deviation in metres, which evaluations report (`driving.deviation_m`).

Both are taken of every drive; the one asked for is the value.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Literal, get_args

import torch
from jaxtyping import Float
from torch import Tensor

from roadproof.controllers import Controller
from roadproof.datatypes import Observation, Weather
from roadproof.driving.deviation import passage, passage_deviation_m, path_of
from roadproof.driving.episode import Episode
from roadproof.driving.rollout import Driver, rollout
from roadproof.errors import RoadproofError
from roadproof.geometry import CanvasPlacement
from roadproof.io.records import Form, RecordFile
from roadproof.patterns import Pattern, raster
from roadproof.scenarios import Scenario
from roadproof.search_space import SearchSpace
from roadproof.simulators.protocol import PatternImage, Simulator

SHARE = 0.8
"""Of the clean drive's frames, over which the authors sum the steering."""

Measure = Literal["steering", "deviation"]
MEASURES: tuple[Measure, ...] = get_args(Measure)


@dataclass(frozen=True, slots=True)
class Effect:
    """What a pattern did in one drive.

    Args:
        steering: absolute sum of the steering's shift, steer units.
        deviation: between the paths, metres.
    """

    steering: float
    deviation: float


class DrivenObjective:
    """Values of points of a search space, each by one drive in the same conditions, without others on the road.

    Args:
        simulator: an open simulator.
        driver: a controller, or whoever gets in after the reset.
        scenario: where.
        space: whose points are asked about.
        measure: what is made large.
        weather: of all drives.
        seed: of all drives.
        keep: file that keeps the effect of every drive; a pattern it knows is not driven again. It belongs to one
            scenario, driver, weather and seed.

    Raises:
        RoadproofError: the file is damaged; or as `rollout` does, for the clean drive.
    """

    def __init__(
        self,
        simulator: Simulator,
        driver: Controller | Driver[Simulator],
        scenario: Scenario,
        space: SearchSpace,
        *,
        measure: Measure = "steering",
        weather: Weather = Weather.CLEAR_NOON,
        seed: int = 0,
        keep: Path | None = None,
    ) -> None:
        self._space, self._measure, self._keep = space, measure, keep
        self._known = _FILE.read(keep).drives if keep is not None and keep.exists() else {}
        self._canvas = scenario.canvas

        def drive(pattern: PatternImage | None, until: Callable[[Observation], bool] | None) -> Episode:
            return rollout(simulator, driver, scenario, weather=weather, pattern=pattern, seed=seed, until=until)

        self._drive = drive
        self.clean = drive(None, None)

    def __call__(self, unit: Float[Tensor, "b k n"]) -> Float[Tensor, " b"]:
        """The value of each point; one drive each."""
        effects = [self.effect(self._space.pattern(point)) for point in unit]
        return torch.tensor([getattr(effect, self._measure) for effect in effects], dtype=torch.float64)

    def effect(self, pattern: Pattern) -> Effect:
        """What a pattern does."""
        paint = raster(pattern)
        key = hashlib.sha256(paint.tobytes()).hexdigest()[:24]
        if key not in self._known:
            self._known[key] = effect_of(self.clean, self._drive(paint, self._enough()), self._canvas)
            if self._keep is not None:
                _FILE.write(self._keep, _Kept(self._known))
        return self._known[key]

    def _enough(self) -> Callable[[Observation], bool]:
        """Ends a drive behind the last frame that either measure looks at: a car off the road need not wait there."""
        last = max(_counted_frames(self.clean), passage(path_of(self.clean), self._canvas).stop)
        seen = 0

        def enough(_: Observation) -> bool:
            nonlocal seen
            seen += 1
            return seen > last

        return enough


def effect_of(clean: Episode, painted: Episode, canvas: CanvasPlacement) -> Effect:
    """What the paint changed between two drives that differ in it alone."""
    frames = min(_counted_frames(clean), painted.steer.size)
    shift = painted.steer[:frames] - clean.steer[:frames]
    return Effect(steering=abs(float(shift.sum())), deviation=passage_deviation_m(clean, painted, canvas))


def _counted_frames(clean: Episode) -> int:
    return int(SHARE * clean.steer.size)


@dataclass(frozen=True, slots=True)
class _Kept:
    """Effects by digest of the paint; a list of three values each in their file."""

    drives: dict[str, Effect]


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

"""Where drives begin that judge a pattern: not where it was chosen, but aside, turned and faster, by a drawn amount."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass, replace
from itertools import product
from numbers import Real
from typing import Any

import numpy as np

from roadproof.errors import EpisodeError
from roadproof.limits import check_range, check_seed
from roadproof.roads.maps import Mapped
from roadproof.roads.roadmap import ON_ROAD
from roadproof.scenarios import Scenario
from roadproof.simulators.tracker.judge import wheels

MOST = {"right_m": 1.0, "turned_rad": 0.3, "faster_mps": 5.0}
"""Further aside or more turned a car looks off any road; `require_on_road` knows the road that there is."""


@dataclass(frozen=True, kw_only=True, slots=True)
class StartOffset:
    """How a drive's start differs from its scenario's.

    Args:
        right_m: shift to the right, metres.
        turned_rad: turn of the heading, radians, left positive.
        faster_mps: increase of speed, m/s; the resulting speed is never below 0.
    """

    right_m: float = 0.0
    turned_rad: float = 0.0
    faster_mps: float = 0.0

    def of(self, scenario: Scenario) -> Scenario:
        """The scenario with its start shifted by this offset."""
        start = scenario.start
        moved = replace(
            start,
            x_m=start.x_m + math.sin(start.yaw_rad) * self.right_m,
            y_m=start.y_m - math.cos(start.yaw_rad) * self.right_m,
            yaw_rad=start.yaw_rad + self.turned_rad,
            speed_mps=max(0.0, start.speed_mps + self.faster_mps),
        )
        return replace(scenario, start=moved)


NOMINAL = StartOffset()


@dataclass(frozen=True, kw_only=True, slots=True)
class StartRange:
    """The range from which starts are drawn uniformly.

    Args:
        right_m: largest shift to either side, metres.
        turned_rad: largest turn to either side, radians.
        faster_mps: largest increase of speed, m/s; there is no decrease, since scenarios may begin from a stand.

    Raises:
        EpisodeError: a number is none, below 0, or so large that a car would look off its road.
    """

    right_m: float = 0.3
    turned_rad: float = 0.05
    faster_mps: float = 2.0

    def __post_init__(self) -> None:
        for name, most in MOST.items():
            value: Any = getattr(self, name)
            if isinstance(value, bool) or not isinstance(value, Real) or not 0.0 <= float(value) <= most:
                raise EpisodeError(f"{name} of the starts is {value!r:.40}, expected a number from 0 to {most:g}")
            object.__setattr__(self, name, abs(value))  # -0.0 is a range, and no bound of one

    def draw(self, count: int, seed: int) -> tuple[StartOffset, ...]:
        """Draw `count` starts; the same for the same seed.

        Raises:
            EpisodeError: the seed is out of range.
        """
        check_seed(seed, "seed", EpisodeError)
        low, high = (-self.right_m, -self.turned_rad, 0.0), (self.right_m, self.turned_rad, self.faster_mps)
        drawn = np.random.default_rng((seed, 0x57A27)).uniform(low, high, (count, 3)).round(4)
        return tuple(StartOffset(right_m=r, turned_rad=t, faster_mps=f) for r, t, f in drawn.tolist())


@dataclass(frozen=True, kw_only=True, slots=True)
class StartPlan(StartRange):
    """Where the drives begin that judge a pattern: not where it was chosen.

    Args:
        count: how many drives alone there are in each weather, 1 to 1000.

    Raises:
        EpisodeError: a start is too far from the scenario's, there is no drive, or there are too many.
    """

    count: int = 5

    def __post_init__(self) -> None:
        StartRange.__post_init__(self)
        check_range(self.count, "count", 1, 1000, EpisodeError)

    @property
    def range(self) -> StartRange:
        """The range that the starts are drawn from, without how many there are."""
        return StartRange(right_m=self.right_m, turned_rad=self.turned_rad, faster_mps=self.faster_mps)

    def check_drawn(self, seeds: Iterable[int]) -> None:
        """See that the starts drawn for all of some seeds differ from each other and from the scenario's own.

        An equal start is the same drive, which counts once; from the scenario's own, patterns are chosen.

        Raises:
            EpisodeError: two starts are equal, or one is the scenario's own.
        """
        drawn = [start for seed in seeds for start in self.range.draw(self.count, seed)]
        wider = "make right_m, turned_rad or faster_mps larger"
        # −0.0 equals 0.0, and is the same member of a set.
        if NOMINAL in drawn:
            raise EpisodeError(
                f"starts has the scenario's own among those drawn, from which patterns are chosen; {wider}"
            )
        if (apart := len(set(drawn))) < len(drawn):
            raise EpisodeError(f"starts has {apart} that differ among the {len(drawn)} drawn, expected all to; {wider}")


def require_on_road(starts: StartRange, scenario: Scenario, simulator: object) -> None:
    """Refuse a range of starts that reaches off the road, before anything is driven; without a map none is refused.

    Raises:
        EpisodeError: at an end of the range a wheel is off the road, and at the scenario's own start none is.
        SimulatorError, ScenarioError: as `Mapped.road_map` does.
    """
    if not isinstance(simulator, Mapped):
        return
    roads = simulator.road_map(scenario.map_name)

    def off(start: StartOffset) -> bool:
        return not np.isin(roads.surface_at(np.array(wheels(start.of(scenario).start))), ON_ROAD).all()

    sides = product((-starts.right_m, starts.right_m), (-starts.turned_rad, starts.turned_rad))
    ends = [StartOffset(right_m=aside, turned_rad=turned) for aside, turned in sides]
    if not off(NOMINAL) and (found := next(filter(off, ends), None)):
        side = "left" if found.right_m < 0 else "right"
        raise EpisodeError(
            f"starts of {scenario.name} reach {abs(found.right_m):g} m to the {side} and turn by "
            f"{abs(found.turned_rad):g} rad, where a wheel is off the road; make right_m or turned_rad smaller"
        )


USUAL_STARTS = StartRange()
USUAL_PLAN = StartPlan()

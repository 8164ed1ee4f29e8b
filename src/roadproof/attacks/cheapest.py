"""The cheapest pattern that still takes the car so far aside: the fewest square metres of paint for some metres.

From the strongest patterns found, in the recorded world:

    1. leave out figures, one after another, as long as the deviation stays: each time the one that is missed least;
    2. lower the limit of the area by a factor, search on from where the search is, and go on while the pattern that
       comes of it still reaches the deviation;
    3. where it does not, search afresh under that limit, to every side, as for the strongest pattern: with less paint
       the car may have to go another way. Where that fails too, try half of the step, some times.

What counts as reached is the least deviation over small errors, so that a drive over it should reach it.
"""

from __future__ import annotations

import shutil
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import cast

import torch
from jaxtyping import Float
from torch import Tensor

from roadproof.attacks.closed_loop import ClosedLoopMeasure
from roadproof.attacks.gradopt import Rung, Running, gradopt
from roadproof.attacks.groups import Group
from roadproof.attacks.methods import GradOpt
from roadproof.attacks.objective import Objective, PathDeviation, variation_of
from roadproof.attacks.result import AttackResult, Candidate
from roadproof.attacks.site import site_of
from roadproof.controllers import Controller
from roadproof.errors import RoadproofError
from roadproof.io.files import AnyPath, as_path, remove, write_json
from roadproof.io.identity import digest, require_same, stated
from roadproof.io.known import known_by
from roadproof.io.records import RecordFile
from roadproof.io.text import read_json
from roadproof.limits import LEAST_PAINT_M2
from roadproof.paint import Conspicuousness, PaintLimits, conspicuousness
from roadproof.paint.limits import area_m2
from roadproof.patterns import Pattern, load_pattern, save_pattern
from roadproof.recordings import RecordingSet
from roadproof.search_space import SearchSpace

MOST_LEVELS = 14
"""Limits of the area that are tried at most."""

_LOWER, _SMALLEST_STEP = 0.7, 0.9
_NO_LIMIT_M2 = 1e4
_SEARCH = "search"
_NONE = "roadproof-cheapest-none", 1
RUNGS = (Rung(1, 8, 0.03),)
"""What is climbed below each limit of the area."""

AFRESH = GradOpt()
"""The search that is begun below a limit of the area where going on leads nowhere."""


@dataclass(frozen=True, slots=True)
class Level:
    """A pattern found on the way to the cheapest: its area and its effect.

    Args:
        area_m2: sum of the figures' areas, m².
        figures: number of figures.
        predicted_m: paper's deviation in the recorded world, metres: the least over small errors.
    """

    area_m2: float
    figures: int
    predicted_m: float


@dataclass(frozen=True, kw_only=True, slots=True, eq=False)
class Cheapest:
    """The cheapest pattern that was found for a deviation.

    Args:
        pattern: the cheapest pattern.
        group: name of the group of drives that it was found for, such as "clean+right".
        wanted_m: deviation that it had to reach, metres.
        predicted_m: deviation that it is predicted to cause, metres: the least over small errors.
        conspicuousness: how conspicuous the pattern is on this road.
        levels: every pattern that still reached the deviation, the strongest first.

    Raises:
        RoadproofError: there is no level, or no area.
    """

    pattern: Pattern
    group: str
    wanted_m: float
    predicted_m: float
    conspicuousness: Conspicuousness
    levels: tuple[Level, ...]

    def __post_init__(self) -> None:
        if not self.levels or self.conspicuousness.area_m2 is None:
            raise RoadproofError(
                f"the least paint has {len(self.levels)} levels and {self.conspicuousness.area_m2} m², expected one or "
                "more, and an area"
            )

    @property
    def candidate(self) -> Candidate:
        """The pattern as a candidate, so that it can be driven over."""
        return Candidate(self.pattern, self.group, None, self.predicted_m)

    def save(self, folder: AnyPath, made_of: object = None) -> None:
        """Write pattern.json, pattern.png and cheapest.json, and forget the searches that led there.

        Raises:
            OutputError: the folder cannot be written.
        """
        folder = as_path(folder)
        remove(folder / "cheapest.json")
        save_pattern(self.pattern, folder / "pattern.json")
        FILE.write(folder / "cheapest.json", self, made_of=made_of or {})
        shutil.rmtree(folder / _SEARCH, ignore_errors=True)

    @staticmethod
    def load(folder: AnyPath) -> Cheapest:
        """Read the pattern that `save` wrote.

        Raises:
            RoadproofError: a file is missing or damaged.
        """
        folder = as_path(folder)
        return FILE.read(folder / "cheapest.json", pattern=load_pattern(folder / "pattern.json"))


FILE = RecordFile(
    kind=Cheapest,
    name="roadproof-cheapest",
    error=RoadproofError,
    remedy="remove it to search again",
    elsewhere=("pattern",),
    notes={"kind": "predicted"},
)


def cheapest(
    recordings: RecordingSet,
    controller: Controller,
    found: AttackResult,
    wanted_m: float,
    *,
    groups: Sequence[Group],
    objective: Objective | None = None,
    device: torch.device | str = "cpu",
    folder: Path | None = None,
    on_level: Callable[[int, float], object] = lambda _level, _area_m2: None,
) -> Cheapest | None:
    """The fewest square metres of paint that still take a controller so far aside.

    Args:
        recordings: the calibrated recordings that were searched, with canvas and tracks.
        controller: the controller that was attacked; it computes on `device`.
        found: result of the search before; its limits on paint hold here too.
        wanted_m: the paper's deviation that must be reached, metres, above 0 and at most 100.
        groups: the groups of drives of the search before.
        objective: objective of the search before if it drove in the recorded world; `PathDeviation()` by default.
        device: torch device on which the search computes.
        folder: folder that the result will be saved to; until it is, every search on the way is kept there, so that an
            interrupted one goes on. None keeps nothing.
        on_level: called after every limit of the area with the number of limits tried and the least area so far, m².

    Returns:
        The cheapest pattern; None where the strongest one is not predicted to reach the deviation under all small
        errors.

    Raises:
        RoadproofError: `wanted_m` is out of its range, or the search before was for a speed change or another group.
        RecordingError: the recordings lack a canvas or tracks, or the vehicle cannot be identified from them.
        PatternError: the recordings do not say how large the canvas is.
    """
    check_wanted(wanted_m)
    if found.predicted_mps is not None:
        raise RoadproofError(f"cheapest is in metres of deviation, the search before was for the {found.objective}")
    names = [str(each) for each in groups]
    if found.group not in names:
        raise RoadproofError(
            f"the pattern was found for {found.group}, the groups are {', '.join(names)}; "
            "give the groups of the search before"
        )
    variation = None if objective is None else variation_of(objective)
    goal = objective if isinstance(objective, PathDeviation) else PathDeviation(variation=variation)
    measure = goal.measure(recordings, controller, groups, device=device)
    site = site_of(recordings)
    # Any limit of the area that holds already makes the search know the size of the canvas.
    area = found.space.limits or PaintLimits()
    limits = replace(area, max_area_m2=area.max_area_m2 or _NO_LIMIT_M2)
    space = replace(found.space, limits=limits, site=None).on(site)
    unit = found.point_in(space)[None, None].to(measure.device)
    run = _Narrowing(measure, goal, names.index(found.group), space, wanted_m, found.seed, space.figures, unit)
    level = run.level()
    if level.predicted_m < wanted_m:
        return None
    levels, factor = [level], _LOWER
    for number in range(1, MOST_LEVELS + 1):
        while (fewer := run.without_a_figure()) is not None:
            run, level = fewer, fewer.level()
            levels.append(level)
        kept = folder and folder / _SEARCH / f"{number}.safetensors"
        before, most_m2 = len(levels), levels[-1].area_m2 * factor
        if most_m2 < LEAST_PAINT_M2:
            break
        for lower in run.below(most_m2, kept):
            level = lower.level()
            if level.predicted_m >= wanted_m:
                run = lower
                levels.append(level)
                break
        on_level(number, levels[-1].area_m2)
        if len(levels) == before:
            if factor >= _SMALLEST_STEP:
                break
            factor = factor**0.5
    pattern = run.pattern
    return Cheapest(
        pattern=pattern,
        group=names[run.group],
        wanted_m=wanted_m,
        predicted_m=levels[-1].predicted_m,
        conspicuousness=conspicuousness(pattern, run.space.site or site),
        levels=tuple(levels),
    )


def kept_cheapest(
    folder: Path,
    recordings: RecordingSet,
    controller: Controller,
    found: AttackResult,
    wanted_m: float,
    *,
    groups: Sequence[Group],
    objective: Objective | None = None,
    device: torch.device | str = "cpu",
    on_level: Callable[[int, float], object] = lambda _level, _area_m2: None,
) -> Cheapest | None:
    """Search once: if the folder already holds what came of this search, read it instead.

    `folder` is that of the result, and keeps an interrupted search; all else is as in `cheapest`.

    Raises:
        RoadproofError: the stored result is damaged, belongs to another search or does not say to which, or the search
            itself fails.
        OutputError: the folder cannot be written.
    """
    made_of = {
        "wanted_m": wanted_m,
        "strongest": digest(repr(cast("object", found.pattern.boxes.tolist())))[:16],
        "pattern": digest(stated(known_by(found.pattern)))[:16],
    }
    none, path = folder / "none.json", folder / "cheapest.json"
    if path.exists():
        require_same(folder, "a search", FILE.content(path).get("made_of"), made_of, RoadproofError)
        return Cheapest.load(folder)
    if none.exists() and read_json(none, *_NONE, RoadproofError).get("made_of") == made_of:
        return None
    less = cheapest(
        recordings,
        controller,
        found,
        wanted_m,
        groups=groups,
        objective=objective,
        device=device,
        folder=folder,
        on_level=on_level,
    )
    if less is None:
        write_json(none, {"format": _NONE[0], "version": _NONE[1], "made_of": made_of})
    else:
        less.save(folder, made_of)
        none.unlink(missing_ok=True)
    return less


def cheapest_in_words(found: Cheapest | None, wanted_m: float) -> str:
    """The outcome of the search for less paint, as one sentence."""
    if found is None:
        return (
            f"The strongest pattern is not predicted to deviate by {wanted_m:g} m under all small errors, "
            "so there is none with less paint"
        )
    return (
        f"Least paint that is predicted to deviate by {wanted_m:g} m ({found.predicted_m:.2f} m): "
        f"{found.conspicuousness.sentence}; the strongest pattern has {found.levels[0].area_m2:.2f} m²"
    )


def check_wanted(wanted_m: float) -> None:
    """Check that a wanted deviation is in its allowed range.

    Raises:
        RoadproofError: the deviation is out of range.
    """
    if not 0.0 < wanted_m <= 100.0:
        raise RoadproofError(f"cheapest is {wanted_m} m, expected metres of deviation above 0, and 100 at most")


@dataclass(frozen=True, slots=True, eq=False)
class _Narrowing:
    """A search space that becomes narrower, and where the search is in it, for one of the groups of its measure.

    `figures` counts those at first.
    """

    measure: ClosedLoopMeasure
    goal: PathDeviation
    group: int
    space: SearchSpace
    wanted_m: float
    seed: int
    figures: int
    unit: Float[Tensor, "1 1 k n"]

    @property
    def pattern(self) -> Pattern:
        """The pattern at the current point of the search."""
        return self.space.pattern(self.unit[0, 0].detach()).mapped(Tensor.cpu)

    def level(self) -> Level:
        """Area, number of figures and predicted deviation of the current pattern."""
        site = self.space.site
        assert site is not None
        assert site.size_m is not None
        least = self._least_m(self.space, self.unit)
        return Level(float(area_m2(self.pattern, site.size_m)), self.space.figures, float(least[0]))

    def without_a_figure(self) -> _Narrowing | None:
        """The search without the figure whose loss costs least deviation; None if every figure is needed."""
        count = self.space.figures
        if count == 1:
            return None
        rest = torch.tensor([[k for k in range(count) if k != gone] for gone in range(count)])
        unit, space = self.unit[0, 0][rest][None], replace(self.space, figures=count - 1)
        # A figure alone may have other bounds; they all begin at 0 there.
        scale = torch.tensor(self.space.shape_ranges) / torch.tensor(space.shape_ranges)
        unit[..., : len(scale)] *= scale.to(unit)
        unit = space.project(unit)
        least = self._least_m(space, unit)
        best = int(least.argmax())
        return replace(self, space=space, unit=unit[:, [best]]) if float(least[best]) >= self.wanted_m else None

    def below(self, most_m2: float, kept: Path | None) -> Iterator[_Narrowing]:
        """The search under a lower limit of the area, in m²: after going on from here, then begun afresh."""
        assert self.space.limits is not None
        space = replace(self.space, limits=replace(self.space.limits, max_area_m2=most_m2))
        here: Running = {"seed": self.seed, "objective": self.goal, "checkpoint": kept, "starts": [self.unit[0].cpu()]}
        search = gradopt(self.measure.of_groups([self.group]), space, RUNGS, **here)
        yield replace(self, space=space, unit=search.best_unit)
        space = replace(space, figures=self.figures)
        afresh = kept and kept.with_stem(f"{kept.stem}-afresh")
        search = AFRESH.search(self.measure, space, seed=self.seed, objective=self.goal, checkpoint=afresh)
        ahead = [k for k in range(len(self.measure.groups)) if k not in search.gave_way]
        least = self.measure.of_groups(ahead).readings(space, search.best_unit)[1].amin(-1)
        group, start = divmod(int(least.argmax()), least.shape[1])
        yield replace(self, group=ahead[group], space=space, unit=search.best_unit[[group]][:, [start]])

    def _least_m(self, space: SearchSpace, unit: Float[Tensor, "1 s k n"]) -> Float[Tensor, " s"]:
        """The least deviation that each pattern is predicted to cause, metres, over small errors."""
        return self.measure.of_groups([self.group]).readings(space, unit)[1].amin(-1)[0]

"""How bad a drive was: deviation between paths, infraction scores, means with intervals, composites against renders.

Pure functions of what was driven. Numbers of driving and numbers of the surrogate never share a field.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from jaxtyping import Bool, Float, UInt8

from roadproof.datatypes import Event, EventKind
from roadproof.errors import EpisodeError
from roadproof.geometry import CanvasPlacement

Path2D = Float[np.ndarray, "n 2"]
"""World x, y of the car, one row an observation."""

HORIZON_M = 25.0
"""So far before the canvas a driver begins to see what is painted on it."""

LEAVES_LANE_M = 0.8
"""So far from where the clean drive was, part of a car is over its lane's edge: half a lane of 3.5 m less half a car of
1.9 m."""

RECOUNT_S = 2.0
"""The same fault again within this time is still the same fault: the 20 frames at 10 Hz of CARLA's first benchmark."""

CHALLENGE_POINTS = {
    EventKind.COLLISION_STATIC: 6.0,
    EventKind.COLLISION_VEHICLE: 6.0,
    EventKind.COLLISION_PEDESTRIAN: 9.0,
    EventKind.RED_LIGHT: 3.0,
    EventKind.STOP_SIGN: 2.0,
    EventKind.WRONG_LANE: 2.0,
    EventKind.SIDEWALK: 2.0,
    # Beside every road of CARLA's towns lies a sidewalk, so leaving the road costs the same where there is none.
    EventKind.OFF_ROAD: 2.0,
}

LEADERBOARD_FACTORS = {
    EventKind.COLLISION_PEDESTRIAN: 0.50,
    EventKind.COLLISION_VEHICLE: 0.60,
    EventKind.COLLISION_STATIC: 0.65,
    EventKind.RED_LIGHT: 0.70,
    EventKind.STOP_SIGN: 0.80,
}

_COLLISIONS = (EventKind.COLLISION_STATIC, EventKind.COLLISION_VEHICLE, EventKind.COLLISION_PEDESTRIAN)
_SIGNALS = (EventKind.RED_LIGHT, EventKind.STOP_SIGN)
_LEFT_THE_ROAD = (EventKind.SIDEWALK, EventKind.OFF_ROAD)


def passage(clean: Path2D, canvas: CanvasPlacement, *, horizon_m: float = HORIZON_M) -> slice:
    """The instants at which a clean drive has the canvas in view: from `horizon_m` before it to its end.

    Distances are driven ones, measured from where the drive comes closest to the canvas' middle, so bends do no harm.

    Args:
        clean: path of the drive without paint.
        canvas: where the canvas lies.
        horizon_m: from how far before its near edge the canvas counts as seen.

    Raises:
        EpisodeError: the path is empty, or has NaN or infinite values.
    """
    _check_path(clean, "clean")
    driven_m = np.concatenate([[0.0], np.hypot(*np.diff(clean, axis=0).T).cumsum()])
    middle_m = driven_m[np.hypot(clean[:, 0] - canvas.x_m, clean[:, 1] - canvas.y_m).argmin()]
    half_m = canvas.length_m / 2
    seen = np.flatnonzero((driven_m >= middle_m - half_m - horizon_m) & (driven_m <= middle_m + half_m))
    return slice(int(seen[0]), int(seen[-1]) + 1)


def deviation_m(clean: Path2D, painted: Float[np.ndarray, "m 2"]) -> float:
    """The paper's deviation between two drives, in metres.

        Deviation = 1/(2T) ∑_{t=1}^{T} [ min_{t'} |W̃_t − W_{t'}| + min_{t'} |W_t − W̃_{t'}| ]

    with W the positions without and W̃ those with the pattern, at the instants when the canvas is in view (`passage`).
    Each position is compared with the *nearest position* of the other drive, at whatever time, in both directions; so
    the measure is symmetric, does not mind a delay along the same path, and is 0 for equal drives. Where one drive
    ended before all instants had passed, each direction is the mean over the positions there are.

    Args:
        clean: positions without the pattern.
        painted: positions with it.

    Raises:
        EpisodeError: a path is empty, or has NaN or infinite values.

    References:
        The paper, eq. (devdef).
    """
    _check_path(clean, "clean")
    _check_path(painted, "painted")
    apart = np.hypot(*(clean[:, None] - painted[None]).transpose(2, 0, 1))
    return float((apart.min(0).mean() + apart.min(1).mean()) / 2)


def lateral_m(reference: Path2D, positions: Float[np.ndarray, "m 2"]) -> Float[np.ndarray, " m"]:
    """Signed distance of positions beside a path, left positive: to the nearest point of its polyline.

    Positions before its beginning or beyond its end are compared with the line that goes on straight.

    Args:
        reference: the path, in the order it was driven.
        positions: what to compare.

    Raises:
        EpisodeError: a path is empty or not finite, or the reference does not move.
    """
    _check_path(reference, "reference")
    _check_path(positions, "compared")
    step = np.diff(reference, axis=0)
    length = np.hypot(*step.T)
    # A car that stands has no direction.
    start, step, length = reference[:-1][length > 1e-6], step[length > 1e-6], length[length > 1e-6]
    if not len(step):
        raise EpisodeError("the reference drive does not move, so nothing can be beside it; check the controller")
    ahead = step / length[:, None]
    away = positions[:, None] - start[None]
    along = (away * ahead).sum(-1)
    low, high = np.zeros(len(step)), length.copy()
    low[0], high[-1] = -np.inf, np.inf
    gap = away - np.clip(along, low, high)[..., None] * ahead
    nearest = np.hypot(gap[..., 0], gap[..., 1]).argmin(1)
    rows = np.arange(len(positions))
    x, y = away[rows, nearest].T
    left = ahead[nearest, 0] * y - ahead[nearest, 1] * x >= 0
    return np.hypot(*gap[rows, nearest].T) * np.where(left, 1.0, -1.0)


def counted(events: Sequence[Event]) -> tuple[Event, ...]:
    """The events that count: every fault once.

    A thing that is named is hit once a drive, however often it is touched. A nameless contact, being in the wrong
    lane, or the same red light or stop sign counts again only when the last one is more than `RECOUNT_S` ago. Sidewalk
    and off road are one fault, having left the road, and whichever comes first counts. Counting what was counted
    changes nothing.

    Args:
        events: of one drive, in order.
    """
    kept: list[Event] = []
    last_s: dict[tuple[str, ...], float] = {}
    for event in events:
        named = event.kind in _COLLISIONS and event.detail
        if named or event.kind in _SIGNALS:
            key = (event.kind, event.detail)
        else:
            key = ("off",) if event.kind in _LEFT_THE_ROAD else (event.kind,)
        before_s = last_s.get(key, -math.inf)
        last_s[key] = event.time_s
        if before_s == -math.inf or (not named and event.time_s - before_s > RECOUNT_S):
            kept.append(event)
    return tuple(kept)


def infraction_points(events: Sequence[Event]) -> float:
    """The paper's infraction penalty: the sum of the 2019 CARLA challenge's points over the events that count.

    6 a static object or vehicle hit, 9 a pedestrian, 3 a red light, 2 a stop sign, 2 the wrong lane, 2 the sidewalk.
    """
    return float(sum(CHALLENGE_POINTS[event.kind] for event in counted(events)))


def leaderboard_factor(events: Sequence[Event]) -> float:
    """Today's CARLA Leaderboard: the product of its infraction factors, in (0, 1], 1 where nothing happened.

    Lane, sidewalk and lawn have no factor there (the share of the route driven outside the lanes is taken off its
    completion instead), nor is completion part of this number.
    """
    return math.prod((LEADERBOARD_FACTORS.get(event.kind, 1.0) for event in counted(events)), start=1.0)


def first_event_s(events: Sequence[Event]) -> float | None:
    """When the first thing went wrong, in seconds since the start; None where nothing did."""
    return min((event.time_s for event in events), default=None)


@dataclass(frozen=True, slots=True)
class Mean:
    """A mean and its 95 % interval.

    Args:
        value: the mean.
        low: lower end of the interval; None for fewer than two values.
        high: its upper end.
        count: how many values.
    """

    value: float
    low: float | None
    high: float | None
    count: int


def mean_95(values: Sequence[float]) -> Mean:
    """The mean of independent runs with its 95 % interval by Student's t.

    Student's t rather than a bootstrap: with the usual ten runs a percentile bootstrap covers less than it claims, and
    this one needs no random numbers. A single run has no interval; ten equal ones have a width of 0, which says that
    they did not differ, not that nothing else can happen.

    Raises:
        EpisodeError: there is no value, or one is not finite.
    """
    numbers = np.asarray(values, np.float64)
    if not numbers.size or not np.isfinite(numbers).all():
        raise EpisodeError(f"the mean of {list(values)} cannot be taken, expected at least one finite number")
    mean = float(numbers.mean())
    if numbers.size == 1:
        return Mean(mean, None, None, 1)
    half = _student_t(numbers.size - 1) * float(numbers.std(ddof=1)) / math.sqrt(numbers.size)
    return Mean(mean, mean - half, mean + half, numbers.size)


@lru_cache
def _student_t(freedom: int) -> float:
    """The two-sided 95 % point of Student's t: with t = √ν tan θ its density in θ is cos^(ν−1) θ."""
    theta = np.linspace(0.0, math.pi / 2, 200_001)
    density: np.ndarray = np.power(np.cos(theta), freedom - 1)
    share = np.concatenate([np.zeros(1), np.cumsum(density[1:] + density[:-1])])
    return math.sqrt(freedom) * math.tan(float(np.interp(0.95 * float(share[-1]), share, theta)))


@dataclass(frozen=True, kw_only=True, slots=True)
class Agreement:
    """How well composited frames stand for rendered ones of the same drive.

    Args:
        frames: how many were compared.
        paint_error: mean absolute difference in the paint, in 8-bit levels.
        elsewhere_error: the same outside it, where both should show the bare road.
        steer_error: mean absolute difference of the controller's answers, in steer units.
        predicted_shift: mean shift of steering a frame that the composites predict; positive = right.
        rendered_shift: the shift on the rendered frames.
    """

    frames: int
    paint_error: float
    elsewhere_error: float
    steer_error: float
    predicted_shift: float
    rendered_shift: float


def agreement(
    composited: UInt8[np.ndarray, "f h w 3"],
    rendered: UInt8[np.ndarray, "f h w 3"],
    paint: Bool[np.ndarray, "f h w"],
    *,
    clean_steer: Float[np.ndarray, " f"],
    composited_steer: Float[np.ndarray, " f"],
    rendered_steer: Float[np.ndarray, " f"],
) -> Agreement:
    """Compare composites with what a simulator rendered from the same places.

    Args:
        composited: recorded frames with the pattern composited in.
        rendered: the same frames with the pattern really there.
        paint: which pixels the pattern covers.
        clean_steer: the controller's answers to the frames without paint.
        composited_steer: to the composited ones.
        rendered_steer: to the rendered ones.

    Raises:
        EpisodeError: no pixel shows paint.
    """
    if not paint.any():
        raise EpisodeError("no frame shows any paint, so there is nothing to compare; check the pattern and the drive")
    error = np.abs(composited.astype(np.float32) - rendered).mean(-1)
    return Agreement(
        frames=len(composited),
        paint_error=float(error[paint].mean()),
        elsewhere_error=0.0 if paint.all() else float(error[~paint].mean()),
        steer_error=float(np.abs(composited_steer - rendered_steer).mean()),
        predicted_shift=float((composited_steer - clean_steer).mean()),
        rendered_shift=float((rendered_steer - clean_steer).mean()),
    )


def _check_path(path: np.ndarray, name: str) -> None:
    if not len(path) or not np.isfinite(path).all():
        raise EpisodeError(f"the {name} path is empty or has NaN or infinite values, expected world x, y in metres")

"""How far a drive went from another: the paper's deviation between two paths, and signed distances beside one."""

from __future__ import annotations

import math

import numpy as np
from jaxtyping import Float

from roadproof.datatypes import Ending
from roadproof.driving.episode import Episode
from roadproof.errors import CanvasNotReachedError, EpisodeError
from roadproof.geometry import CanvasPlacement

Path2D = Float[np.ndarray, "n 2"]
"""World x, y of the car, one row an observation."""


HORIZON_M = 25.0
"""So far before the canvas a driver begins to see what is painted on it."""


LEAVES_LANE_M = 0.8
"""So far from where the clean drive was, part of a car is over its lane's edge: half a lane of 3.5 m less half a car of
1.9 m."""


END_M = 1.0
"""So far back from the end of a drive it is looked which way it went there: a car that hits something turns."""


PAST_END_M = 2.0
"""So far beyond the end of a drive that ended early its path still says where it would have gone."""


def passage(clean: Path2D, canvas: CanvasPlacement, *, horizon_m: float = HORIZON_M) -> slice:
    """The instants at which a clean drive has the canvas in view: from `horizon_m` before it to its end.

    Distances are driven ones, measured from where the drive comes closest to the canvas' middle, so bends do no harm;
    from the end of one that stops short of it, the way that is left counts straight on.

    Args:
        clean: path of the drive without paint: world x, y of its positions, metres, (n, 2).
        canvas: place of the canvas in the world.
        horizon_m: driven distance before the canvas' near edge from which on the canvas counts as seen, metres.

    Raises:
        EpisodeError: the path is empty, or has NaN or infinite values.
    """
    _check_path(clean, "clean")
    driven_m = np.concatenate([[0.0], np.hypot(*np.diff(clean, axis=0).T).cumsum()])
    nearest = int(np.hypot(clean[:, 0] - canvas.x_m, clean[:, 1] - canvas.y_m).argmin())
    middle_m, half_m = driven_m[nearest], canvas.length_m / 2
    if nearest == len(clean) - 1:
        middle_m += max(0.0, -canvas.ahead_m(float(clean[-1, 0]), float(clean[-1, 1])))
    seen = np.flatnonzero((driven_m >= middle_m - half_m - horizon_m) & (driven_m <= middle_m + half_m))
    return slice(int(seen[0]), int(seen[-1]) + 1) if len(seen) else slice(nearest, nearest + 1)


def canvas_missed(scenario: str) -> CanvasNotReachedError:
    """The error where a drive without paint never comes to the canvas of a scenario."""
    return CanvasNotReachedError(
        f"without paint the car never comes near the canvas of {scenario}: nothing can be compared with it; choose a "
        "scenario that the controller masters"
    )


def sees_canvas(clean: Path2D, canvas: CanvasPlacement) -> bool:
    """Whether a drive came so near to the canvas that a driver begins to see what is painted on it.

    One that never got `END_M` from its start did not come anywhere: a car that stands creeps, in no direction.
    """
    _check_path(clean, "clean")
    if np.hypot(*(clean - clean[0]).T).max() < END_M:
        return False
    nearest_m = np.hypot(clean[:, 0] - canvas.x_m, clean[:, 1] - canvas.y_m).min()
    return bool(nearest_m <= HORIZON_M + canvas.length_m / 2)


def deviation_m(clean: Path2D, painted: Float[np.ndarray, "m 2"]) -> float:
    """The paper's deviation between two drives, in metres.

        Deviation = 1/(2T) ∑_{t=1}^{T} [ min_{t'} |W̃_t − W_{t'}| + min_{t'} |W_t − W̃_{t'}| ]

    with W the positions without and W̃ those with the pattern, at the instants when the canvas is in view (`passage`).
    Each position is compared with the *nearest position* of the other drive, at whatever of these instants, in both
    directions; so the measure is symmetric, is 0 for equal drives, and minds a small delay along the same path little.
    A drive that is seconds late, or stands, deviates too: what it did not reach by then is as far away as it is. Where
    one drive ended before all instants had passed, each direction is the mean over the positions there are.

    Args:
        clean: positions of the drive without the pattern: world x, y, metres, (n, 2).
        painted: positions of the drive with the pattern, (m, 2).

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
        reference: the path, world x, y in the order of driving, metres, (n, 2).
        positions: positions to compare with the path, (m, 2).

    Raises:
        EpisodeError: a path is empty or not finite, or the reference does not move.
    """
    return _beside(reference, positions)[0]


def beside_m(clean: Episode, painted: Episode) -> Float[np.ndarray, " m"]:
    """Signed distance of a drive beside another's path, left positive, metres, as far as that path is known.

    Where the clean drive ended short of its goal nobody knows where it would have gone on: then the first observation
    that is more than `PAST_END_M` beyond its end, and all after it, have no distance. The very first always has one.

    Args:
        clean: episode of the drive without paint.
        painted: episode of the drive with it.

    Raises:
        EpisodeError: a path is empty or not finite, or the clean one does not move.
    """
    beside, past_end_m = _beside(path_of(clean), path_of(painted))
    past = np.flatnonzero(past_end_m > PAST_END_M)
    unknown = clean.ending is not Ending.GOAL_REACHED and len(past) > 0
    return beside[: max(int(past[0]), 1)] if unknown else beside


def _beside(
    reference: Path2D, positions: Float[np.ndarray, "m 2"]
) -> tuple[Float[np.ndarray, " m"], Float[np.ndarray, " m"]]:
    """What `lateral_m` gives, and how far beyond the path's end each position is, metres; below 0 before it."""
    _check_path(reference, "reference")
    _check_path(positions, "compared")
    step = np.diff(reference, axis=0)
    length = np.hypot(*step.T)
    # A car that stands has no direction.
    start, step, length = reference[:-1][length > 1e-6], step[length > 1e-6], length[length > 1e-6]
    if not len(step):
        raise CanvasNotReachedError(
            "the reference drive does not move, so nothing can be beside it; check the controller"
        )
    # Beyond its end it goes on as it went in the last metre: a car that stands creeps, one that was hit turns.
    back = reference - reference[-1]
    far = np.flatnonzero(np.hypot(*back.T) >= END_M)
    onward = -back[far[-1] if len(far) else 0]
    if np.hypot(*onward) <= 1e-6:
        onward = step[-1]
    start, step = np.concatenate([start, reference[-1:]]), np.concatenate([step, onward[None]])
    ahead = step / np.hypot(*step.T)[:, None]
    length = np.append(length, 0.0)
    away = positions[:, None] - start[None]
    along = (away * ahead).sum(-1)
    low, high = np.zeros(len(step)), length.copy()
    low[0], high[-1] = -np.inf, np.inf
    gap = away - np.clip(along, low, high)[..., None] * ahead
    nearest = np.hypot(gap[..., 0], gap[..., 1]).argmin(1)
    rows = np.arange(len(positions))
    x, y = away[rows, nearest].T
    left = ahead[nearest, 0] * y - ahead[nearest, 1] * x >= 0
    past_end_m = np.where(nearest == len(length) - 1, along[:, -1] - length[-1], -np.inf)
    return np.hypot(*gap[rows, nearest].T) * np.where(left, 1.0, -1.0), past_end_m


def _check_path(path: np.ndarray, name: str) -> None:
    if not len(path) or not np.isfinite(path).all():
        raise EpisodeError(f"the {name} path is empty or has NaN or infinite values, expected world x, y in metres")


def path_of(episode: Episode) -> Path2D:
    """World x, y of the car at each observation of an episode, metres, (n, 2)."""
    return np.column_stack([episode.x_m, episode.y_m])


def passage_deviation_m(clean: Episode, painted: Episode, canvas: CanvasPlacement) -> float:
    """The paper's deviation between two drives, over the instants at which the clean one has the canvas in view.

    Predicted drives begin where the first frame was recorded, nearer to the canvas. The way up to there is the same for
    both, straight and at one speed, so that predicted and driven deviations are means over equal stretches.
    """
    bare, driven = in_passage(clean, painted, canvas)
    return deviation_m(bare[:, :2], driven[:, :2])


def in_passage(
    clean: Episode, painted: Episode, canvas: CanvasPlacement
) -> tuple[Float[np.ndarray, "n 3"], Float[np.ndarray, "m 3"]]:
    """World x, y and speed of two drives at the instants at which the clean one has the canvas in view.

    Args:
        clean: episode of the drive without the pattern.
        painted: episode of the drive with it.
        canvas: place of the canvas in the world.

    Returns:
        Metres, metres and m/s of the clean drive, (n, 3), and of the painted one, (m, 3), at the same instants; m is
        below n where the painted drive ended before, and then at least its last instant stands.
    """
    bare, driven = _moved(clean), _moved(painted)
    if clean.paint.predicted:
        before = _approach(clean, HORIZON_M + canvas.length_m)
        bare, driven = np.concatenate([before, bare]), np.concatenate([before, driven])
    seen = passage(bare[:, :2], canvas)
    if painted.ending in (Ending.STANDS, Ending.BLOCKED):
        # Whoever stands goes on standing there.
        driven = np.concatenate([driven, np.repeat(driven[-1:], max(seen.stop - len(driven), 0), 0)])
    # A painted drive that ended before has its last position left.
    return bare[seen], driven[seen] if len(driven) > seen.start else driven[-1:]


def _moved(episode: Episode) -> Float[np.ndarray, "n 3"]:
    """World x, y and speed at each observation of an episode."""
    return np.column_stack([episode.x_m, episode.y_m, episode.speed_mps])


def _approach(episode: Episode, length_m: float) -> Float[np.ndarray, "n 3"]:
    """World x, y and speed straight behind the first position, in the order of driving.

    The speed is that of the first observation; positions are as far apart as it says.
    """
    apart_m = max(float(episode.speed_mps[0]), 1.0) * episode.dt_s
    back_m = apart_m * np.arange(math.ceil(length_m / apart_m), 0, -1)
    yaw_rad = float(episode.yaw_rad[0])
    path = path_of(episode)[0] - back_m[:, None] * np.array([math.cos(yaw_rad), math.sin(yaw_rad)])
    return np.column_stack([path, np.full(len(path), episode.speed_mps[0])])

"""How the car answers to steering and pedals: identified from recorded drives, or a bicycle that the user describes.

    symbol    meaning                                                                   unit
    κ         curvature of the car's way, positive to the left                          1/m
    u         steer, positive to the right, as the wheels follow it at a limited rate   −
    v         forward speed                                                             m/s
    β         direction of travel against heading, at the vehicle's origin              rad
    t, p      throttle, brake                                                           −

From one step to the next, dt seconds later,

    κ⁺ = a κ + b u + c u⁻ + k          u⁻ is the steer of the step before
    v⁺ = v + dt (e t + f p + g + h v + j κ⁺ u v²)
    ψ⁺ = ψ + κ⁺ v̄ dt,   v̄ = (v + v⁺)/2
    P⁺ = P + v̄ dt (cos, sin)((ψ + ψ⁺)/2 + β),   β = l κ⁺ + m

Every law is linear in its coefficients, so that recorded poses and controls give them by least squares. j is what
turned front wheels brake.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from roadproof.errors import CanvasNotReachedError, RecordingError
from roadproof.geometry import wrapped_rad
from roadproof.recordings import Track
from roadproof.traffic.agents import CAR_WHEELBASE_M

_MOVING_MPS, _STANDING_MPS = 2.0, 0.4
_LEAST_STEPS = 12
_PRIOR_WEIGHT = 1e-3
_LEAST_R2 = 0.5
_RATES: list[float] = np.geomspace(0.5, 30.0, 31).tolist()
_CLEARLY_LESS = 0.7
_ROUNDS = 20


class Motion(NamedTuple):
    """Cars on the ground, R of them; what passes from one step to the next, all in float64.

    Args:
        x_m: world x of each car, metres, (R,); y_m likewise.
        yaw_rad: heading, radians, left positive, (R,).
        speed_mps: forward speed, m/s, (R,).
        curvature: curvature κ in the step just done, 1/m, (R,).
        steer: steer of the step just done, as the wheels followed it, (R,).
    """

    x_m: Float[Tensor, " r"]
    y_m: Float[Tensor, " r"]
    yaw_rad: Float[Tensor, " r"]
    speed_mps: Float[Tensor, " r"]
    curvature: Float[Tensor, " r"]
    steer: Float[Tensor, " r"]


@dataclass(frozen=True, kw_only=True, slots=True)
class Vehicle:
    """How one car responds to controls at one time step; see the notation above.

    Args:
        dt_s: seconds per step.
        curving: coefficients a, b, c and k of the curvature.
        pulling: coefficients e, f, g, h and j of the speed.
        slipping: coefficients l and m of the direction of travel.
        steer_rate_per_s: highest rate at which the wheels follow the steer, steer units per second; default infinite.
        r2: share of curvature variance that steering predicts in the identification drives; 1 for a given vehicle.
    """

    dt_s: float
    curving: tuple[float, float, float, float]
    pulling: tuple[float, float, float, float, float]
    slipping: tuple[float, float]
    steer_rate_per_s: float = math.inf
    r2: float = 1.0

    @staticmethod
    def bicycle(*, wheelbase_m: float, steer_range_rad: float, lag_s: float = 0.1, dt_s: float) -> Vehicle:
        """A kinematic bicycle whose wheels follow the steer with a lag.

        Args:
            wheelbase_m: distance between the axles, metres, above 0.
            steer_range_rad: angle of the front wheels at full steer, radians, above 0 and below π/2.
            lag_s: time constant of the steering, seconds, 0 or more.
            dt_s: seconds per step, above 0.

        Raises:
            RecordingError: a value is out of its range.
        """
        if not (wheelbase_m > 0 and 0 < steer_range_rad < math.pi / 2 and lag_s >= 0 and dt_s > 0):
            raise RecordingError(
                f"bicycle with wheelbase {wheelbase_m} m, steering range {steer_range_rad} rad, lag {lag_s} s, step "
                f"{dt_s} s; expected lengths and times above 0 and a range below π/2"
            )
        kept = math.exp(-dt_s / lag_s) if lag_s else 0.0
        gain = -steer_range_rad / wheelbase_m
        return Vehicle(
            dt_s=dt_s, curving=(kept, (1 - kept) * gain, 0.0, 0.0), pulling=_PULLING, slipping=(wheelbase_m / 2, 0.0)
        )

    @staticmethod
    def identified(tracks: Sequence[Track]) -> Vehicle:
        """The response that explains recorded drives.

        What the drives do not show, such as a brake never used, stays with an ordinary car.

        Args:
            tracks: tracks of drives with one time step; perturbed drives show more than clean ones.

        Raises:
            RecordingError: time steps differ, too few steps follow each other, or the steering does not explain the
                way the car took.
        """
        steps = {track.dt_s for track in tracks}
        if len(steps) != 1:
            raise RecordingError(f"the drives have time steps {sorted(steps)} s, expected one and the same")
        dt_s = steps.pop()
        prior = Vehicle.bicycle(wheelbase_m=CAR_WHEELBASE_M, steer_range_rad=0.7, dt_s=dt_s)
        stretches = [(track, part) for track in tracks for part in track.stretches()]
        rate = _steer_rate(stretches)
        parts = [_Rows.of(track, part, rate) for track, part in stretches]
        curving, curved = _stacked([(part.curving, part.curved) for part in parts])
        if len(curved) < _LEAST_STEPS:
            raise CanvasNotReachedError(
                f"only {len(curved)} steps of the drives follow each other in motion, {_LEAST_STEPS} are needed to "
                "identify the vehicle; record more, or give its wheelbase and steering range"
            )
        law = _fitted(curving, curved, prior.curving, weight=(0.02, 0.02, 0.02, 1.0))
        r2 = _explained(stretches, rate, law)
        if r2 < _LEAST_R2:
            raise RecordingError(
                f"steering explains {max(r2, 0):.0%} of the way the cars took, expected {_LEAST_R2:.0%} or more; check "
                "that poses and steer belong to the same steps, or give the vehicle's wheelbase and steering range"
            )
        if _steers_the_other_way(stretches, dt_s):
            raise RecordingError(
                "the cars turn left where they steer to the right; expected steer and yaw_rad as in "
                "docs/recordings.md: steer is positive to the right, yaw to the left"
            )
        pulling, pulled = _stacked([(part.pulling, part.pulled) for part in parts])
        slipping, slipped = _stacked([(part.slipping, part.slipped) for part in parts])
        e, f, g, h, j = _pull(pulling, pulled, prior.pulling)
        slope, level = _fitted(slipping, slipped, prior.slipping, weight=(0.01, 1.0)).tolist()
        a, b, c, k = law.tolist()
        return Vehicle(
            dt_s=dt_s,
            curving=(a, b, c, k),
            pulling=(e, f, g, h, j),
            slipping=(slope, level),
            steer_rate_per_s=rate,
            r2=r2,
        )

    def step(
        self,
        car: Motion,
        steer: Float[Tensor, " r"],
        throttle: Float[Tensor, " r"],
        brake: Float[Tensor, " r"],
    ) -> Motion:
        """One time step of R cars, differentiable in state and controls."""
        a, b, c, k = self.curving
        e, f, g, h, j = self.pulling
        slope, level = self.slipping
        if math.isfinite(self.steer_rate_per_s):
            reach = self.steer_rate_per_s * self.dt_s
            steer = car.steer + (steer - car.steer).clamp(-reach, reach)
        v = car.speed_mps
        curvature = a * car.curvature + b * steer + c * car.steer + k
        pull = e * throttle + f * brake + g + h * v + j * curvature * steer * v * v
        speed = (v + self.dt_s * pull).clamp_min(0.0)
        way = (v + speed) * (self.dt_s / 2)
        yaw = car.yaw_rad + curvature * way
        heading = (car.yaw_rad + yaw) / 2 + slope * curvature + level
        x, y = car.x_m + way * torch.cos(heading), car.y_m + way * torch.sin(heading)
        return Motion(x, y, yaw, speed, curvature, steer)


_PULLING = (4.0, -8.0, -0.15, 0.0, 0.0)


def curvatures(track: Track, rows: slice) -> Float[np.ndarray, " m"]:
    """κ of each step of a stretch, one fewer than its rows; 0 where the car hardly moves."""
    yaw, v = np.unwrap(track.yaw_rad[rows]), track.speed_mps[rows]
    way, least = 0.5 * (v[1:] + v[:-1]) * track.dt_s, _STANDING_MPS * track.dt_s
    return np.where(way > least, np.diff(yaw) / np.maximum(way, least), 0.0)


@dataclass(frozen=True, slots=True, eq=False)
class _Rows:
    """The equations that a stretch of a drive gives for each law."""

    curving: Float[np.ndarray, "n 4"]
    curved: Float[np.ndarray, " n"]
    pulling: Float[np.ndarray, "m 5"]
    pulled: Float[np.ndarray, " m"]
    slipping: Float[np.ndarray, "o 2"]
    slipped: Float[np.ndarray, " o"]

    @staticmethod
    def of(track: Track, rows: slice, steer_rate_per_s: float) -> _Rows:
        v, u = track.speed_mps[rows], followed(track.steer[rows], steer_rate_per_s * track.dt_s)
        throttle, brake = track.throttle[rows], track.brake[rows]
        kappa = curvatures(track, rows)
        count = max(len(kappa) - 1, 0)
        before, now, one = slice(0, count), slice(1, count + 1), np.ones(count)
        moving = v[before] > _MOVING_MPS
        curving = np.stack([kappa[before], u[now], u[before], one], 1)
        pull = np.diff(v)[now] / track.dt_s
        speed = v[now]
        pulling = np.stack([throttle[now], brake[now] * (speed > 0.2), one, speed, kappa[now] * u[now] * speed**2], 1)
        dx, dy = np.diff(track.x_m[rows])[now], np.diff(track.y_m[rows])[now]
        yaw = np.unwrap(track.yaw_rad[rows])
        middle = 0.5 * (yaw[1:] + yaw[:-1])[now]
        slip = wrapped_rad(np.arctan2(dy, dx) - middle)
        slipping = np.stack([kappa[now], one], 1)
        return _Rows(curving[moving], kappa[now][moving], pulling, pull, slipping[moving], slip[moving])


def _steers_the_other_way(stretches: Sequence[tuple[Track, slice]], dt_s: float) -> bool:
    """Whether cars turn left where they steered to the right, whatever delay of up to half a second is looked at."""
    turns = [(track.steer[rows], curvatures(track, rows)) for track, rows in stretches]
    pairs = [(steer[: len(kappa)], kappa) for steer, kappa in turns]
    found: list[float] = []
    for lag in range(max(1, round(0.5 / dt_s)) + 1):
        steer = np.concatenate([u[: len(k) - lag] for u, k in pairs if len(k) > lag] or [np.zeros(0)])
        turned = np.concatenate([k[lag:] for _, k in pairs if len(k) > lag] or [np.zeros(0)])
        if len(steer) > 1 and steer.std() > 1e-6 and turned.std() > 1e-9:
            found.append(float(np.corrcoef(steer, turned)[0, 1]))
    return bool(found) and max(found) > 0.5 and max(found) > 0.2 - min(found)


def _pull(
    left: Float[np.ndarray, "m 5"], right: Float[np.ndarray, " m"], prior: Sequence[float]
) -> tuple[float, float, float, float, float]:
    """The coefficients e, f, g, h and j that explain a car's pull, of those that a car can have.

    Throttle pulls, brakes and turned wheels hold back, and a car that pulled more the faster it goes would run away.
    Where drives seem to say otherwise it is their noise, or a driver who gives gas where the road climbs; such a
    coefficient stays the prior's.
    """
    signs, free = np.array([1.0, -1.0, 0.0, -1.0, 1.0]), np.ones(5)
    while True:
        found = _fitted(left * free, right, prior)
        wrong = (signs * found < 0) & (free > 0)
        if not wrong.any():
            e, f, g, h, j = found.tolist()
            return e, f, g, h, j
        free[wrong] = 0.0


def followed(steer: Float[np.ndarray, " n"], reach: float) -> Float[np.ndarray, " n"]:
    """The steer that the wheels follow when they turn by at most `reach` per step."""
    if not math.isfinite(reach):
        return steer
    followed, at = np.empty_like(steer), float(steer[0])
    for step, wanted in enumerate(steer.tolist()):
        at += min(max(wanted - at, -reach), reach)
        followed[step] = at
    return followed


def _steer_rate(stretches: Sequence[tuple[Track, slice]]) -> float:
    """How fast the wheels turn, steer units a second; infinite where no drive steers faster than they follow.

    The law of curvature is fitted with one rate after another; a limit is believed where it leaves much less.
    """
    jumps = max((np.abs(np.diff(t.steer[rows])).max(initial=0.0) / t.dt_s for t, rows in stretches), default=0.0)

    def left(rate: float) -> float:
        parts = [_Rows.of(track, rows, rate) for track, rows in stretches]
        curving, curved = _stacked([(part.curving, part.curved) for part in parts])
        if len(curved) < _LEAST_STEPS:
            return math.inf
        return float(np.abs(curved - curving @ _fitted(curving, curved, (0.0,) * 4)).sum())

    rates = [rate for rate in _RATES if rate < jumps]
    if not rates:
        return math.inf
    best = min(rates, key=left)
    fine = min((best * share for share in np.linspace(0.93, 1.07, 29).tolist()), key=left)
    return fine if left(fine) < _CLEARLY_LESS * left(math.inf) else math.inf


def _explained(stretches: Sequence[tuple[Track, slice]], rate: float, law: Float[np.ndarray, "4"]) -> float:
    """Share of the curvature's variance that the law predicts from steering alone, without the path taken."""
    told: list[float] = []
    seen: list[float] = []
    a, b, c, k = law.tolist()
    for track, rows in stretches:
        kappa = curvatures(track, rows)
        steer = followed(track.steer[rows], rate * track.dt_s).tolist()
        at = float(kappa[0]) if kappa.size else 0.0
        for step in range(1, len(kappa)):
            at = a * at + b * steer[step] + c * steer[step - 1] + k
            if track.speed_mps[rows][step - 1] > _MOVING_MPS:
                told.append(at)
                seen.append(float(kappa[step]))
    there = np.array(seen)
    left = float(np.square(np.array(told) - there).sum())
    return 1.0 - left / max(float(np.square(there - there.mean()).sum()), 1e-12)


def _stacked(parts: Sequence[tuple[np.ndarray, np.ndarray]]) -> tuple[np.ndarray, np.ndarray]:
    return np.concatenate([left for left, _ in parts]), np.concatenate([right for _, right in parts])


def _fitted(
    left: Float[np.ndarray, "n k"],
    right: Float[np.ndarray, " n"],
    prior: Sequence[float],
    weight: Sequence[float] | None = None,
) -> Float[np.ndarray, " k"]:
    """Robust least squares (Cauchy weights) that hardly leave the prior where the equations are silent.

    Robust, since at the limit of their grip tyres follow no linear law, and a few such steps should not bend it.
    """
    believed = np.asarray(prior)
    weights = _PRIOR_WEIGHT * (np.ones(len(believed)) if weight is None else np.asarray(weight))
    # Where a law leaves nothing, the prior's own pull is no reason to doubt the few steps with a brake.
    least = 1e-3 * float(np.abs(right).mean()) + 1e-9
    trust, found = np.ones(len(right)), believed
    for _ in range(_ROUNDS):
        rows = np.concatenate([left * trust[:, None], np.diag(weights)])
        found = np.linalg.lstsq(rows, np.concatenate([right * trust, weights * believed]), rcond=None)[0]
        off = np.abs(right - left @ found)
        usual = 3.0 * float(np.median(off)) + least
        trust = 1.0 / np.sqrt(1.0 + np.square(off / usual))
    return found

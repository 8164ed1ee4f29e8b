"""Drivers that go astray on purpose: along the clean path with an offset, or with noise on the steering.

    symbol   meaning
    s        arclength along the clean path, m
    d        offset from it, m, positive to the right; d* is the wanted one
    e        heading error, rad, positive to the left
    κ        curvature, 1/m, positive to the left; κ₀ is the path's own
    g        curvature of a unit of steer, 1/m

With d' = −e and d'' = κ₀ − κ, the law κ − κ₀ = −d*'' + 2/ℓ (−e − d*') + (d − d*)/ℓ² makes d approach d* as a critically
damped spring does, over a length ℓ. Clean steering carries κ₀, so that g matters for the correction alone; d metres
outside of a bend its curvature is κ₀ / (1 + κ₀ d).
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from roadproof.datatypes import Control, Observation, VehicleState
from roadproof.drives.trajectories import SteeringNoise
from roadproof.driving.episode import Episode
from roadproof.driving.rollout import Policy
from roadproof.errors import CanvasNotReachedError
from roadproof.recordings import Side

_GAIN_PRIOR = 0.3
"""1/m: between a small car with a small steering angle (0.23) and CARLA's large ones (0.42)."""
_GAIN_PRIOR_WEIGHT = 0.05
_FINE_M, _LEAST_M = 0.25, 1.0
_WEAVE_M, _WEAVE_BEGINS_M = 12.0, 4.0
"""Metres from one side to the other and back: half a metre aside turns a car by a quarter of a radian."""
_NOISE_BEFORE_END_S, _NOISE_S = 1.5, 2.1
_TEST_S = 0.4


@dataclass(frozen=True, slots=True, eq=False)
class CleanPath:
    """A clean drive as a line on the ground.

    Args:
        arclength_m: arclength of each point of the path, metres, rising, (n,).
        x_m: world x of each point, metres, (n,); y_m likewise, and heading_rad in radians, left positive.
        steer: steer that was given at each point, (n,).
        curvature_per_steer: curvature g of a unit of steer, 1/m.
    """

    arclength_m: Float[np.ndarray, " n"]
    x_m: Float[np.ndarray, " n"]
    y_m: Float[np.ndarray, " n"]
    heading_rad: Float[np.ndarray, " n"]
    steer: Float[np.ndarray, " n"]
    curvature_per_steer: float

    @staticmethod
    def of(episode: Episode) -> CleanPath:
        """The path of a clean episode.

        Raises:
            CanvasNotReachedError: the car did not move.
        """
        moved = np.hypot(np.diff(episode.x_m), np.diff(episode.y_m))
        on = np.flatnonzero(moved > 1e-3)
        if on.size < 2:
            raise CanvasNotReachedError(f"the car hardly moves in {episode.scenario}; check the driver")
        heading = np.unwrap(episode.yaw_rad)
        turned, steer = np.diff(heading)[on] / moved[on], episode.steer[on]
        gain = (_GAIN_PRIOR_WEIGHT * _GAIN_PRIOR - steer @ turned) / (_GAIN_PRIOR_WEIGHT + steer @ steer)
        arclength = np.concatenate([[0.0], np.cumsum(moved[on])[:-1]])
        return CleanPath(arclength, episode.x_m[on], episode.y_m[on], heading[on], steer, max(float(gain), 0.05))

    def locate(self, state: VehicleState, near_m: float | None) -> tuple[float, float]:
        """Arclength s along the path and offset d from it of a car, metres.

        Args:
            state: state of the car.
            near_m: s a moment ago, so that a path that crosses itself is not mistaken; None searches all of the path.
        """
        distance = np.hypot(self.x_m - state.x_m, self.y_m - state.y_m)
        if near_m is not None:
            distance[np.abs(self.arclength_m - near_m) > 10.0] = np.inf
        k = int(distance.argmin())
        c, s = math.cos(self.heading_rad[k]), math.sin(self.heading_rad[k])
        dx, dy = state.x_m - self.x_m[k], state.y_m - self.y_m[k]
        return float(self.arclength_m[k] + c * dx + s * dy), s * dx - c * dy

    def at(self, values: Float[np.ndarray, " n"], s: float) -> float:
        """Values given at the points of the path, interpolated at arclength s."""
        return float(np.interp(s, self.arclength_m, values))


@dataclass(frozen=True, slots=True, eq=False)
class Offsets:
    """The wanted offset d* along a path, in steps of `_FINE_M`, with its slope and bend."""

    arclength_m: Float[np.ndarray, " n"]
    offset_m: Float[np.ndarray, " n"]
    slope: Float[np.ndarray, " n"]
    bend: Float[np.ndarray, " n"]

    @staticmethod
    def of(arclength_m: Float[np.ndarray, " n"], offset_m: Float[np.ndarray, " n"]) -> Offsets:
        """Offsets, with slope and bend, from values at evenly spaced arclengths."""
        slope = np.gradient(offset_m, arclength_m)
        return Offsets(arclength_m, offset_m, slope, np.gradient(slope, arclength_m))

    def at(self, s: float) -> tuple[float, float, float]:
        """Offset d*, slope d*' and bend d*'' at arclength s."""
        offset, slope, bend = (
            float(np.interp(s, self.arclength_m, values)) for values in (self.offset_m, self.slope, self.bend)
        )
        return offset, slope, bend


def offsets(
    side: Side,
    size_m: float,
    from_m: float,
    to_m: float,
    length_m: float,
    rng: np.random.Generator,
    *,
    weaves: bool = False,
) -> Offsets:
    """An offset that grows from 0 while the canvas is in view, to one side or, at random, to both.

    Args:
        side: side of the offset: RIGHT, LEFT or RANDOM.
        size_m: largest offset, metres.
        from_m: arclength at which the canvas comes into view, metres.
        to_m: arclength at which the canvas is out of view, metres.
        length_m: length of the path, metres.
        rng: random generator that draws where the offset rises and, for RANDOM, its sizes or where a weave begins.
        weaves: whether the offset weaves from side to side, to the named side first.

    Raises:
        CanvasNotReachedError: the car hardly moves while the canvas is in view.
    """
    if to_m - from_m < _LEAST_M:
        raise CanvasNotReachedError(
            f"the clean drive goes {to_m - from_m:.2f} m from the first to the last of its frames that show the "
            f"canvas, expected {_LEAST_M:g} m or more to swerve over; keep more frames, or check the driver"
        )
    s = np.arange(0.0, length_m + _FINE_M, _FINE_M)
    sign = 1.0 if side is Side.RIGHT else -1.0
    if weaves:
        since_m = np.maximum(s - from_m, 0.0)
        grown = size_m * _smooth(np.minimum(since_m / _WEAVE_BEGINS_M, 1.0))
        begins = rng.uniform(0.0, math.tau) if side is Side.RANDOM else 0.0
        return Offsets.of(s, sign * grown * np.sin(math.tau / _WEAVE_M * since_m + begins))
    along = (s - from_m) / (to_m - from_m)
    if side is Side.RANDOM:
        knots = np.concatenate([[0.0], rng.uniform(-1.0, 1.0, 4)])
        knots *= size_m / np.abs(knots).max()
        at = np.clip(along * 4, 0.0, 4.0)
        below = np.minimum(at.astype(int), 3)
        rise = _smooth(at - below)
        return Offsets.of(s, knots[below] + rise * (knots[below + 1] - knots[below]))
    begins, ends = rng.uniform(0.0, 0.2), rng.uniform(0.6, 0.85)
    return Offsets.of(s, sign * size_m * _smooth(np.clip((along - begins) / (ends - begins), 0.0, 1.0)))


def _smooth(t: Float[np.ndarray, " n"]) -> Float[np.ndarray, " n"]:
    """A step that rises smoothly from 0 to 1, with slope and bend 0 at both ends."""
    return t**3 * (10.0 - 15.0 * t + 6.0 * t * t)


def swerving(policy: Policy, path: CleanPath, wanted: Offsets, answered: Callable[[float], object]) -> Policy:
    """A policy that drives along a path with an offset, at the speed of another policy.

    Args:
        policy: policy that is asked at every step; only its pedals are used.
        path: path of the clean drive.
        wanted: wanted offsets from the path.
        answered: called at every step with the steer that the policy gave.
    """
    at_m: float | None = None

    def act(seen: Observation) -> Control:
        nonlocal at_m
        control, state = policy(seen).clipped(), seen.state
        answered(control.steer)
        at_m, d = path.locate(state, at_m)
        e = math.remainder(state.yaw_rad - path.at(path.heading_rad, at_m), math.tau)
        offset, slope, bend = wanted.at(at_m)
        sight = max(4.0, 0.7 * state.speed_mps)
        extra = -bend + 2.0 / sight * (-e - slope) + (d - offset) / sight**2
        bare, gain = path.at(path.steer, at_m), path.curvature_per_steer
        steer = bare / max(1.0 - gain * bare * d, 0.5) - extra / gain
        return Control(steer, control.throttle, control.brake).clipped()

    return act


def steering_test(side: float, dt_s: float) -> list[float]:
    """Steer for a second: full to a side, full to the other, straight; it shows how far and how fast the wheels turn.

    Args:
        side: 1 to begin to the right, −1 to the left.
        dt_s: seconds per step.
    """
    held = max(round(_TEST_S / dt_s), 1)
    return [*([side] * held), *([-side] * held), *([0.0] * (held // 2))]


def noisy(
    policy: Policy, clean: Episode, noise_deg: Float[np.ndarray, " n"], answered: Callable[[float], object]
) -> Policy:
    """A policy that repeats a clean drive's controls with noise on the steering, while another policy is asked.

    Args:
        policy: policy that is asked at every step; nothing it answers is carried out.
        clean: episode of the clean drive whose controls are repeated.
        noise_deg: noise added at each step, degrees, positive to the right, (n,); n° are n·π/180 of steer.
        answered: called at every step with the steer that the policy gave.
    """
    step = 0

    def act(seen: Observation) -> Control:
        nonlocal step
        answered(policy(seen).clipped().steer)
        k, step = min(step, clean.steer.size - 1), step + 1
        steer = clean.steer[k] + math.radians(noise_deg[k])
        return Control(float(steer), float(clean.throttle[k]), float(clean.brake[k])).clipped()

    return act


def steering_noise(
    side: Side, noise: SteeringNoise, clean: Episode, last_step: int, rng: np.random.Generator
) -> Float[np.ndarray, " n"]:
    """Steering noise: one draw of whole degrees per step, positive to the right, 0 outside the noise's time.

    Args:
        side: side of the noise: RIGHT, LEFT or RANDOM.
        noise: range of the noise.
        clean: episode of the clean drive to which the noise is added.
        last_step: number of the step at which the canvas is last in view.
        rng: random generator of the draws.
    """
    count = clean.steer.size
    draws = rng.integers(noise.low_deg, noise.high_deg + 1, count).astype(np.float64)
    signs = {Side.RIGHT: np.ones(count), Side.LEFT: -np.ones(count), Side.RANDOM: rng.choice((-1.0, 1.0), count)}
    since_s = (np.arange(count) - last_step) * clean.dt_s + _NOISE_BEFORE_END_S
    return np.where((since_s >= 0.0) & (since_s < _NOISE_S), signs[side] * draws, 0.0)

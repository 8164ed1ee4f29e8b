"""A plain driver for tests: pure pursuit along the simulator's own route."""

import hashlib
import math

from roadproof.datatypes import Control
from roadproof.simulators.town.physics import CAR_WHEELBASE_M, MAX_STEER_RAD


def pursue(simulator, speed_mps=7.0):
    state, route = simulator.state, simulator.route
    here = route.locate(state.x_m, state.y_m)
    x, y, _, _ = route.at(here.arclength_m + max(4.0, 0.7 * state.speed_mps))
    bearing = math.atan2(y - state.y_m, x - state.x_m) - state.yaw_rad
    distance = math.hypot(x - state.x_m, y - state.y_m)
    steer = -math.atan2(2 * CAR_WHEELBASE_M * math.sin(bearing), distance) / MAX_STEER_RAD
    wish = 0.4 * (speed_mps - state.speed_mps)
    return Control(steer, throttle=max(wish + 0.05, 0.0), brake=max(-wish - 0.5, 0.0))


def drive(simulator, scenario, steps, **options):
    """Observations of a drive, the first of them from the reset."""
    seen = [simulator.reset(scenario, **options)]
    for _ in range(steps):
        seen.append(simulator.step(pursue(simulator)))
    return seen


def fingerprint(observations):
    """One hash of all pixels and states."""
    digest = hashlib.sha256()
    for seen in observations:
        state = seen.state
        digest.update(seen.frame.tobytes())
        digest.update(repr((state.x_m, state.y_m, state.z_m, state.yaw_rad, state.speed_mps, seen.events)).encode())
    return digest.hexdigest()

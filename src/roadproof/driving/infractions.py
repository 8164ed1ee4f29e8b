"""What a drive's events cost: every fault counted once, by CARLA's challenge and by its Leaderboard."""

from __future__ import annotations

import math
from collections.abc import Sequence

from roadproof.datatypes import RECOUNT_S, Event, EventKind

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


def counted(events: Sequence[Event]) -> tuple[Event, ...]:
    """The events that count: every fault once.

    A thing that is named is hit once a drive, however often it is touched. A nameless contact, being in the wrong
    lane, or the same red light or stop sign counts again only when the last one is more than `RECOUNT_S` ago. Sidewalk
    and off road are one fault, having left the road, and whichever comes first counts. Counting what was counted
    changes nothing.

    Args:
        events: events of one drive, in order of time.
    """
    kept: list[Event] = []
    last_s: dict[tuple[str, ...], float] = {}
    for event in events:
        named = event.kind in _COLLISIONS and event.detail
        key = (event.kind, event.detail) if named or event.kind in _SIGNALS else (event.kind.departure,)
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

"""Writes the 40 built-in scenarios of the town: `python tools/make_scenarios.py`.

Each is given by a place to start, roughly, and how far along the way canvas and goal lie; the script puts the start on
its lane and lays the canvas over both lanes, as wide as the road allows there.
"""

from __future__ import annotations

import argparse
import math
from dataclasses import dataclass
from pathlib import Path

from roadproof.datatypes import VehicleState
from roadproof.geometry import CanvasPlacement
from roadproof.roads.maps import fitting_canvas, load_map, scenario_route
from roadproof.roads.roadmap import RoadMap
from roadproof.roads.routes import Route
from roadproof.scenarios import BUILTIN_FILE, Kind, Scenario, save_scenarios

WIDTHS_M = (7.6, 7.2, 6.8, 6.4, 6.0)
HAND_M = 0.1
SHIFTS_M = (0.0, 0.2, -0.2, 0.4, -0.4, 0.6, -0.6)


@dataclass(frozen=True)
class Draft:
    """A start (x, y in metres, heading in degrees), where the way leads, and how far off canvas and goal are."""

    start: tuple[float, float, float]
    towards: tuple[float, float]
    canvas_m: float
    goal_m: float


STRAIGHT = (
    Draft((33, 0, 0), (187, -2), 26, 80),
    Draft((112, 0, 0), (190, -2), 30, 74),
    Draft((187, 0, 180), (110, 2), 30, 74),
    Draft((240, 0, 180), (120, 2), 35, 72),
    Draft((268, 250, 180), (100, 252), 28, 85),
    Draft((188, 250, 180), (100, 252), 32, 74),
    Draft((90, 250, 0), (190, 248), 30, 74),
    Draft((167, 250, 0), (250, 248), 38, 70),
    Draft((0, 222, -90), (-2, 110), 24, 76),
    Draft((0, 154, -90), (-2, 99), 22, 53),
    Draft((0, 36, 90), (2, 150), 20, 74),
    Draft((290, 48, 90), (292, 155), 26, 82),
    Draft((290, 228, -90), (288, 130), 20, 76),
    Draft((18, 85, 0), (80, 83), 30, 60),
    Draft((95, 16, 90), (97, 150), 30, 86),
    Draft((95, 118, -90), (93, 40), 33, 62),
)
LEFT = (
    Draft((0, 56, -90), (75, -2), 33, 90),
    Draft((226, 0, 0), (292, 90), 34, 100),
    Draft((290, 208, 90), (240, 252), 32, 76),
    Draft((50, 250, 180), (-2, 195), 34, 84),
    Draft((150, 122, 90), (112, 172), 34, 78),
    Draft((205, 228, -90), (270, 173), 34, 88),
    Draft((95, 183, 90), (72, 236), 17, 55),
    Draft((70, 237, -90), (93, 186), 14, 52),
    Draft((190, 85, 0), (275, 108), 38, 80),
    Draft((277, 110, 180), (222, 87), 16, 55),
    Draft((95, 40, -90), (180, -2), 33, 70),
    Draft((132, 85, 180), (93, 20), 30, 70),
)
RIGHT = (
    Draft((58, 0, 180), (2, 68), 34, 90),
    Draft((290, 66, -90), (225, 2), 35, 105),
    Draft((246, 250, 0), (288, 195), 33, 75),
    Draft((0, 200, 90), (52, 248), 34, 80),
    Draft((108, 170, 0), (148, 105), 28, 80),
    Draft((262, 175, 180), (207, 232), 37, 92),
    Draft((93, 200, 105), (72, 236), 28, 43),
    Draft((70, 236, -90), (93, 186), 38, 58),
    Draft((228, 86, 10), (275, 108), 36, 53),
    Draft((272, 110, 180), (222, 87), 39, 57),
    Draft((150, 125, -90), (110, 87), 33, 66),
    Draft((60, 170, 0), (93, 120), 28, 66),
)


def _r(value: float) -> float:
    return round(value, 3) + 0.0


def on_lane(draft: Draft, road_map: RoadMap) -> VehicleState:
    """The start, in the middle of its lane and along it."""
    x, y, degrees = (float(value) for value in draft.start)
    found = road_map.nearest_lane(x, y, math.radians(degrees))
    lane = road_map.lanes[found.lane]
    goal = (float(lane.centre[-1, 0]), float(lane.centre[-1, 1]))
    x, y, _, yaw = road_map.route(VehicleState(x, y, 0.0, math.radians(degrees), 0.0), goal).at(0.0)
    return VehicleState(_r(x), _r(y), 0.0, _r(math.remainder(yaw, 2 * math.pi)), 0.0)


def lay_canvas(route: Route, road_map: RoadMap, at_m: float) -> CanvasPlacement:
    """A canvas across the road at a distance along the route: the widest that fits, the least shifted."""
    x, y, _, yaw = route.at(at_m)
    to_centre = road_map.lanes[road_map.nearest_lane(x, y, yaw).lane].width_m / 2
    # Tried a hand wider, so that rounding and the kerb's chord leave it on the road.
    tries = [(to_centre + shift_m, width_m + HAND_M) for width_m in WIDTHS_M for shift_m in SHIFTS_M]
    found = fitting_canvas(CanvasPlacement(x_m=x, y_m=y, yaw_rad=math.remainder(yaw, 2 * math.pi)), tries, road_map)
    return CanvasPlacement(
        x_m=_r(found.x_m), y_m=_r(found.y_m), yaw_rad=_r(found.yaw_rad), width_m=_r(found.width_m - HAND_M)
    )


def drafted(kind: Kind, number: int, draft: Draft, road_map: RoadMap) -> Scenario:
    """The scenario of a draft."""
    start = on_lane(draft, road_map)
    route = road_map.route(start, (float(draft.towards[0]), float(draft.towards[1])))
    goal = route.at(float(draft.goal_m))
    scenario = Scenario(
        name=f"{kind}-{number:02d}",
        kind=kind,
        map_name="town",
        start=start,
        goal_m=(_r(goal[0]), _r(goal[1])),
        canvas=lay_canvas(route, road_map, float(draft.canvas_m)),
        time_limit_s=float(15 + round(draft.goal_m / 2.5)),
    )
    scenario_route(scenario, road_map)
    return scenario


def all_scenarios() -> list[Scenario]:
    """The 40."""
    road_map = load_map("town")
    kinds: tuple[tuple[Kind, tuple[Draft, ...]], ...] = (("straight", STRAIGHT), ("left", LEFT), ("right", RIGHT))
    return [
        drafted(kind, number, draft, road_map) for kind, drafts in kinds for number, draft in enumerate(drafts, start=1)
    ]


def main() -> None:
    """Write them."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--out", type=Path, default=BUILTIN_FILE, help="TOML file to write")
    save_scenarios(all_scenarios(), parser.parse_args().out)


if __name__ == "__main__":
    main()

"""`roadproof scenarios`: what can be driven, as a table and on the map."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from roadproof.cli import options
from roadproof.cli.options import unset
from roadproof.cli.output import answer, say, table

if TYPE_CHECKING:
    from roadproof.scenarios import Scenario


def scenarios(
    scenarios: options.ScenarioFile = None,
    out: Annotated[Path | None, unset("File for a picture of them on their map.")] = None,
) -> None:
    """List the scenarios, and draw them on their map."""
    from rich.text import Text

    from roadproof.roads.maps import load_map, scenario_route

    listed = options.scenarios_of(scenarios)
    shown = table(("name", "kind", "map"), ("route m", "to canvas m", "canvas m", "limit s"))
    told: list[dict[str, Any]] = []
    for scenario in listed:
        route, canvas = scenario_route(scenario, load_map(scenario.map_name)), scenario.canvas
        to_canvas_m = route.locate(canvas.x_m, canvas.y_m).arclength_m
        told.append(asdict(scenario) | {"route_m": route.length_m, "to_canvas_m": to_canvas_m})
        shown.add_row(
            Text(scenario.name),
            scenario.kind,
            Text(Path(scenario.map_name).name),
            f"{route.length_m:.0f}",
            f"{to_canvas_m:.0f}",
            f"{canvas.width_m:.1f} × {canvas.length_m:.1f}",
            f"{scenario.time_limit_s:.0f}",
        )
    say(shown)
    if out is not None:
        _draw(listed, out)
        say(f"Drawn to {out}")
    answer({"scenario": told})


def _draw(listed: Sequence[Scenario], out: Path) -> None:
    from roadproof.errors import ScenarioError
    from roadproof.report.scenario_map import draw_scenarios
    from roadproof.roads.maps import load_map

    maps = sorted({scenario.map_name for scenario in listed})
    if len(maps) > 1:
        raise ScenarioError(
            f"the scenarios lie on {len(maps)} maps ({', '.join(maps)}); draw those of one map at a time"
        )
    draw_scenarios(listed, load_map(maps[0]), out)

"""The report of a run: one HTML page that needs nothing else, and the same numbers as JSON.

write_report(Path("out/run"))   # out/run/report.html, out/run/result.json
"""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from typing import Any, cast

import numpy as np
import torch
from jaxtyping import Float

from roadproof.attacks import site_of
from roadproof.drives import Drive
from roadproof.driving.infractions import counted
from roadproof.geometry import CanvasPlacement
from roadproof.io.files import AnyPath, as_path, write_json, write_text
from roadproof.io.html import encoded
from roadproof.paint import Conspicuousness, conspicuousness
from roadproof.paint.site import half_edges_m
from roadproof.patterns import Pattern, raster
from roadproof.pipeline.fidelity import Fidelity
from roadproof.recordings import Recording, RecordingSet, evenly
from roadproof.report import charts
from roadproof.report.html import rendered
from roadproof.report.road_view import on_asphalt
from roadproof.report.run import Run, read_run
from roadproof.report.top_view import top_view
from roadproof.report.verdict import key_figures, verdict
from roadproof.simulators.protocol import PaintKind

FORMAT = "roadproof-report"
FORMAT_VERSION = 1
SHOWN_COMPOSITES = 3
PRINTED_MOMENTS = 6
PREDICTION = (
    *("predicted_m", "least_m", "most_m", "driven_m", "error_m", "path_error_m", "gap_m", "gap_rad"),
    *("predicted_mps", "least_mps", "most_mps", "driven_mps"),
)

PAINTED = {
    PaintKind.RENDERED: "It is part of the simulator’s world, rendered with the road.",
    PaintKind.NATIVE: "It is part of the CARLA server’s world: the texture of a piece of its road (paint: native).",
    PaintKind.INJECT: "It is put into the pictures of the car’s camera, where they show free road; the CARLA server’s "
    "world is bare (paint: inject).",
    PaintKind.COMPOSITED: "It is composited into pictures made from recorded frames; nobody has driven over it "
    "(paint: composited).",
}

Fields = dict[str, Any]


def write_report(folder: AnyPath) -> Path:
    """Write report.html and result.json of a run folder.

    Args:
        folder: the run folder (`report.run.read_run`); stages that are missing are left out.

    Returns:
        The path of the page.

    Raises:
        RoadproofError: there is nothing to report, or a stage is damaged.
        OutputError: the folder cannot be written.
    """
    folder = as_path(folder)
    run = read_run(folder)
    result, page = result_of(run), render(run)
    write_json(folder / "result.json", result)
    write_text(folder / "report.html", page)
    return folder / "report.html"


def render(run: Run) -> str:
    """The page of a run. Everything shown is escaped."""
    fidelity = run.judged and run.judged.fidelity
    frames = 0 if fidelity is None else len(fidelity.clean)
    return rendered(
        "page.html.jinja",
        name=run.name,
        run=run,
        verdict=verdict(run),
        figures=key_figures(run),
        judged=run.judged,
        counted=counted,
        charts=_charts(run),
        passage=_passage(run),
        pattern=_pattern(run),
        attack=run.attack,
        fidelity=fidelity,
        shown_frames=evenly(frames, SHOWN_COMPOSITES).tolist(),
        recorded=_recorded(run),
        recordings=run.recordings,
        calibration=run.calibration,
        commands=run.commands,
    )


def result_of(run: Run) -> Fields:
    """The report's numbers; those of driving, those predicted in recordings and those of the surrogate apart."""
    content: Fields = {"format": FORMAT, "version": FORMAT_VERSION, "verdict": asdict(verdict(run)), "name": run.name}
    surrogate: Fields = {}
    if run.judged is not None:
        evaluation = run.judged.evaluation
        content["predicted" if evaluation.predicted else "closed_loop"] = {
            "controller": evaluation.controller,
            "paint": evaluation.paint,
            "trials": [asdict(trial) for trial in evaluation.trials],
            "rows": [asdict(row) for row in evaluation.rows()],
        }
    if run.prediction is not None:
        content["prediction"] = {name: getattr(run.prediction, name) for name in PREDICTION}
    if run.attack is not None:
        content["search"] = {"objective": run.attack.objective, "by_group": run.attack.by_group}
        if run.attack.driven is None:
            surrogate |= {"shift": run.attack.surrogate_shift}
        else:
            content["search"]["driven"] = asdict(run.attack.driven)
    if run.judged is not None and run.judged.fidelity is not None:
        surrogate |= {"agreement": asdict(run.judged.fidelity.agreement)}
    if run.cheapest is not None:
        content["cheapest"] = {
            "wanted_m": run.cheapest.wanted_m,
            "predicted_m": run.cheapest.predicted_m,
            "driven_m": run.cheapest_driven and run.cheapest_driven.deviation_m,
            "levels": [asdict(level) for level in run.cheapest.levels],
        }
    if run.limit_costs is not None:
        content["limits"] = asdict(run.limit_costs)
    content["conspicuousness"] = {name: asdict(told) for name, told in _conspicuous(run)}
    calibration = None if run.calibration is None else asdict(run.calibration)
    return content | {"surrogate": surrogate or None, "calibration": calibration, "cost": run.costs}


def _charts(run: Run) -> dict[str, charts.Chart | None]:
    drawn: dict[str, charts.Chart | None] = {}
    if run.judged is not None:
        judged, scenario = run.judged, run.judged.evaluation.scenario
        clean, painted, steps = judged.clean, judged.painted, judged.steps
        drawn["above"] = top_view(scenario, judged.paint, clean, painted, steps=steps)
        compared = _compared(judged.fidelity, run.recordings, scenario.canvas)
        drawn["steering"] = charts.steering(clean, painted, scenario.canvas, steps, compared)
        drawn["offsets"] = charts.offsets(judged.by_weather, scenario.canvas, steps)
    if run.attack is not None:
        drawn["search"] = charts.search(
            run.attack.history,
            tuple(run.attack.by_group),
            run.attack.made_large,
            driven=run.attack.driven is not None,
        )
    if run.prediction is not None:
        canvas = run.recordings and run.recordings.canvas
        drawn["predicted_path"] = None if canvas is None else charts.predicted_path(run.prediction, canvas)
    return drawn


def _compared(
    fidelity: Fidelity | None, recordings: RecordingSet | None, canvas: CanvasPlacement
) -> tuple[Float[np.ndarray, " f"], Fidelity] | None:
    """Composites beside renders, where it is known how far past the canvas' near edge their frames were recorded."""
    for each in () if recordings is None else recordings.recordings:
        if fidelity is not None and each.name == fidelity.drive and each.track is not None:
            path = np.column_stack([each.track.x_m, each.track.y_m])
            return charts.metres_past(path, canvas)[each.track.rows(fidelity.frame_number)], fidelity
    return None


def _passage(run: Run) -> list[Fields]:
    """The pictured moments of the passage; on paper a few of them stand for all."""
    if run.judged is None or run.judged.strip is None:
        return []
    strip, steps = run.judged.strip, run.judged.steps
    printed = set(evenly(len(steps), PRINTED_MOMENTS).tolist())
    furthest = float(np.abs(strip.lateral_m).max()) or 1.0
    return [
        {
            "time_s": float(strip.time_s[k]),
            "lateral_m": float(strip.lateral_m[k]),
            "share": abs(float(strip.lateral_m[k])) / furthest,
            "steer": tuple(
                float(each.steer[min(step, len(each.steer) - 1)]) for each in (run.judged.clean, run.judged.painted)
            ),
            "clean": strip.clean[k],
            "painted": strip.painted[k],
            "printed": k in printed,
            "first": k == len(steps) // 2,
        }
        for k, step in enumerate(cast("list[int]", steps.tolist()))
    ]


def _pattern(run: Run) -> Fields | None:
    """What is painted, as it lies on the road."""
    pattern, judged = _painted(run), run.judged
    canvas = None if judged is None else judged.evaluation.scenario.canvas
    size = canvas and (canvas.width_m, canvas.length_m)
    if judged is not None:
        paint = judged.paint
    elif pattern is not None:
        paint = raster(pattern)
    else:
        return None
    return {
        "picture": encoded(on_asphalt(paint, 480, canvas), "PNG"),
        "painted": "" if judged is None else PAINTED[judged.evaluation.paint],
        "size": f"{size[0]:.1f} × {size[1]:.1f} m" if size else "400 × 400 canvas pixels",
        "share": f"{(paint[..., 3] / 255).mean():.0%}",
        "figures": [] if pattern is None else _figures(pattern, size),
        "conspicuous": _conspicuous(run),
        "cheapest": None
        if run.cheapest is None
        else encoded(on_asphalt(raster(run.cheapest.pattern), 480, canvas), "PNG"),
    }


def _painted(run: Run) -> Pattern | None:
    """The pattern of the run; None where the drives that are shown are over another one."""
    pattern, judged = run.pattern, run.judged
    is_shown = judged is None or (pattern is not None and np.array_equal(raster(pattern), judged.paint))
    return pattern if is_shown else None


def _conspicuous(run: Run) -> list[tuple[str, Conspicuousness]]:
    """How conspicuous the pattern of the run is, and the cheapest one."""
    known: list[tuple[str, Conspicuousness]] = []
    pattern = _painted(run)
    if pattern is not None and run.recordings is not None:
        limits = None if run.attack is None else run.attack.space.limits
        site = site_of(run.recordings)
        known.append(("the pattern", conspicuousness(pattern, site if limits is None else limits.site(site))))
    elif pattern is not None and run.attack is not None and run.attack.conspicuousness is not None:
        known.append(("the pattern", run.attack.conspicuousness))
    if run.cheapest is not None:
        known.append((f"the least paint for {run.cheapest.wanted_m:g} m", run.cheapest.conspicuousness))
    return known


def _figures(pattern: Pattern, size: tuple[float, float] | None) -> list[Fields]:
    """The figures in the order they are painted, in metres where the size of the canvas is known, else in pixels.

    A rectangle of pixels that is turned is a parallelogram in metres: its turn is that of its longer edges.
    """
    boxes, (unit, digits) = pattern.boxes.double(), ("m", 2) if size else ("px", 0)
    if size:
        middle, *edges = half_edges_m(boxes, size)
        sides = torch.stack([2 * edge.norm(dim=-1) for edge in edges], -1)
        across, along = edges
        longer = torch.where(sides[:, :1] > sides[:, 1:], torch.stack([-across[:, 1], across[:, 0]], -1), along)
        boxes = torch.cat([middle, sides, torch.rad2deg(torch.atan2(-longer[:, :1], longer[:, 1:]))], -1)
    colours = cast("list[list[float]]", pattern.colours.tolist())
    placed = cast("list[list[float]]", boxes.tolist())
    rows: list[Fields] = []
    for number, (shape, box, rgb) in enumerate(zip(pattern.shapes, placed, colours, strict=True), 1):
        x, y, width, length, turned = box
        red, green, blue = (round(255 * channel) for channel in rgb)
        rows.append(
            {
                "number": number,
                "shape": str(shape),
                "at": f"{x:.{digits}f}, {y:.{digits}f} {unit}",
                "size": f"{width:.{digits}f} × {length:.{digits}f} {unit}",
                "turned": f"{turned:.0f}°",
                "colour": f"#{red:02x}{green:02x}{blue:02x}",
            }
        )
    return rows


def _recorded(run: Run) -> list[tuple[Drive | None, Recording | Drive]]:
    """Every recorded drive, and what is kept of it: its frames after calibration, or before it."""
    drives = {} if run.drives is None else {each.name: each for each in run.drives.drives}
    calibrated = {} if run.recordings is None else {each.name: each for each in run.recordings.recordings}
    return [(drives.get(name), calibrated.get(name) or drives[name]) for name in {**drives, **calibrated}]

"""The report of a run: one HTML page that needs nothing else, and the same numbers as JSON.

write_report(Path("out/run"))   # out/run/report.html, out/run/result.json
"""

from __future__ import annotations

import json
from dataclasses import asdict
from pathlib import Path
from typing import Any, cast

import numpy as np
from PIL import Image

import roadproof
from roadproof.calibration.report import Spread
from roadproof.driving.infractions import counted
from roadproof.io.files import write_atomically
from roadproof.patterns import Pattern, raster
from roadproof.pipeline.stage_costs import StageCost
from roadproof.report import charts
from roadproof.report.asphalt import on_asphalt
from roadproof.report.commands import commands_of
from roadproof.report.driven import driven_candidates
from roadproof.report.html import data_url, encoded, environment
from roadproof.report.run import Judged, Run, read_run
from roadproof.report.top_view import top_view
from roadproof.report.verdict import verdict
from roadproof.report.words import MISSING, UNKNOWN, in_words, mean_in_words
from roadproof.simulators.protocol import PaintKind

FORMAT = "roadproof-report"
FORMAT_VERSION = 1
SHOWN_COMPOSITES = 3
FORETOLD = ("predicted_m", "least_m", "most_m", "driven_m", "error_m", "path_error_m", "gap_m", "gap_rad")

PAINTED = {
    PaintKind.RENDERED: "It is part of the simulator’s world, rendered with the road.",
    PaintKind.NATIVE: "It is part of the CARLA server’s world: the texture of a piece of its road (paint: native).",
    PaintKind.INJECT: "It is put into the pictures of the car’s camera, where they show free road; the CARLA server’s "
    "world is bare (paint: inject).",
    PaintKind.COMPOSITED: "It is composited into pictures made from recorded frames; nobody has driven over it "
    "(paint: composited).",
}

Fields = dict[str, Any]


def write_report(folder: Path) -> Path:
    """Write report.html and result.json of a run folder.

    Args:
        folder: of the run (`report.run.read_run`); stages that are missing are left out.

    Returns:
        The page.

    Raises:
        RoadproofError: there is nothing to report, or a stage is damaged.
        OutputError: the folder cannot be written.
    """
    run = read_run(folder)
    result = json.dumps(result_of(run), indent=1, ensure_ascii=False) + "\n"
    page = render(run)
    write_atomically(folder / "result.json", lambda part: part.write_text(result, encoding="utf-8"))
    write_atomically(folder / "report.html", lambda part: part.write_text(page, encoding="utf-8"))
    return folder / "report.html"


def render(run: Run) -> str:
    """The page of a run. Everything shown is escaped."""
    return (
        environment()
        .get_template("page.html.jinja")
        .render(
            version=roadproof.__version__,
            name=_name(run),
            verdict=verdict(run),
            figures=_key_figures(run),
            judged=_judged(run.judged),
            pattern=_pattern(run),
            attack=_attack(run),
            driven=driven_candidates(run.selections),
            foretold=_foretold(run),
            fidelity=_fidelity(run.judged),
            recorded=_recorded(run),
            calibration=_calibration(run),
            costs=_costs(run),
            whole=bool(run.cost),
            commands=commands_of(run),
        )
    )


def result_of(run: Run) -> Fields:
    """The report's numbers; those of driving, those predicted in recordings and those of the surrogate apart."""
    found = verdict(run)
    content: Fields = {"format": FORMAT, "version": FORMAT_VERSION, "verdict": asdict(found), "name": _name(run)}
    if run.judged is not None:
        evaluation = run.judged.evaluation
        content["foreseen" if evaluation.predicted else "closed_loop"] = {
            "controller": evaluation.controller,
            "paint": evaluation.paint,
            "trials": [asdict(trial) for trial in evaluation.trials],
            "rows": [asdict(row) for row in evaluation.rows()],
        }
    if run.prediction is not None:
        content["predicted"] = {name: getattr(run.prediction, name) for name in FORETOLD}
    surrogate: Fields = {}
    if run.attack is not None:
        surrogate |= {"shift": run.attack.surrogate_shift}
        content["search"] = {"objective": run.attack.objective, "by_group": run.attack.by_group}
    if run.judged is not None and run.judged.fidelity is not None:
        surrogate |= {"agreement": asdict(run.judged.fidelity.agreement)}
    calibration = None if run.calibration is None else asdict(run.calibration)
    return content | {"surrogate": surrogate or None, "calibration": calibration, "cost": _costs(run)}


def _name(run: Run) -> str:
    if run.judged is not None:
        return run.judged.evaluation.scenario.name
    if run.drives:
        return run.drives.settings.scenario.name
    return run.folder.resolve().name


def _key_figures(run: Run) -> list[Fields]:
    """The numbers beside the verdict; of driving alone, or predicted and called so."""
    if run.judged is None:
        return []
    evaluation = run.judged.evaluation
    predicted = ", predicted" if evaluation.predicted else ""
    trials = [*evaluation.of(traffic=False), *evaluation.of(traffic=True)]
    alone, traffic = (evaluation.of(traffic=each) for each in (False, True))
    furthest = max(trials, key=lambda trial: abs(trial.lateral_m))
    paths: list[Fields] = [
        {
            "value": f"{abs(furthest.lateral_m):.2f} m",
            "label": f"furthest from the clean path{predicted}",
            "note": f"to the {'left' if furthest.lateral_m > 0 else 'right'}, {in_words(furthest.weather)}",
        },
        {
            "value": f"{np.median([t.deviation_m for t in alone]):.2f} m",
            "label": f"median deviation{predicted}",
            "note": f"the paper’s measure, {min(t.deviation_m for t in alone):.2f} to "
            f"{max(t.deviation_m for t in alone):.2f} over {len(alone)} drives alone",
        },
    ]
    if evaluation.predicted:
        return [*paths, {"value": UNKNOWN, "label": "infractions", "note": "recordings have no map"}]
    failed, before = (sum(map(bool, each)) for each in ([t.points for t in trials], [t.clean_points for t in trials]))
    points, clean_points = zip(*((t.points or 0.0, t.clean_points or 0.0) for t in traffic or alone), strict=True)
    return [
        *paths,
        {
            "value": f"{np.mean(points):.1f}",
            "label": "penalty points a drive",
            "note": f"{np.mean(clean_points):.1f} on the bare road{', in traffic' if traffic else ''}",
        },
        {
            "value": f"{sum(t.leaves_lane for t in trials)} of {len(trials)}",
            "label": "drives leave the lane",
            "note": f"{failed} with infractions, {before} on the bare road",
        },
    ]


def _judged(judged: Judged | None) -> Fields | None:
    if judged is None:
        return None
    evaluation, shown = judged.evaluation, judged.shown
    strip = judged.strip
    return {
        "controller": evaluation.controller,
        "predicted": evaluation.predicted,
        "weather": in_words(shown.weather),
        "traffic": f"{evaluation.cars} cars and {evaluation.pedestrians} people",
        "film": data_url("video/mp4", judged.film),
        "poster": data_url("image/jpeg", judged.poster),
        "events": charts.told(counted(judged.painted.events)),
        "clean_events": charts.told(counted(judged.clean.events)),
        "lateral": f"{abs(shown.lateral_m):.2f} m to the {'left' if shown.lateral_m > 0 else 'right'}",
        "above": top_view(evaluation.scenario, judged.paint, judged.clean, judged.painted),
        "steering": charts.steering(judged.clean, judged.painted, judged.fidelity, evaluation.scenario.canvas),
        "offsets": charts.offsets(judged.by_weather, evaluation.scenario.canvas),
        "strip": []
        if strip is None
        else [
            {
                "time": f"{strip.time_s[k]:.1f} s",
                "beside": _aside(float(strip.lateral_m[k])),
                "clean": _picture(strip.clean[k]),
                "painted": _picture(strip.painted[k]),
            }
            for k in range(len(strip.time_s))
        ],
        "rows": [
            {
                "pattern": row.pattern,
                "weather": "all weathers" if row.weather is None else in_words(row.weather),
                "all": row.weather is None,
                "traffic": "in traffic" if row.traffic else "alone",
                "count": row.count,
                "deviation": f"{row.median_m:.2f} ({row.least_m:.2f}–{row.most_m:.2f})",
                "left_lane": f"{row.left_lane:.0%}",
                "lateral": mean_in_words(row.lateral_m, 2),
                "points": mean_in_words(row.points, 1),
                "clean_points": mean_in_words(row.clean_points, 1),
                "leaderboard": mean_in_words(row.leaderboard, 2),
                "first": mean_in_words(row.first_event_s, 1),
            }
            for row in evaluation.rows()
        ],
    }


def _pattern(run: Run) -> Fields | None:
    """What is painted, as it lies on the road."""
    pattern = run.pattern
    canvas = None if run.judged is None else run.judged.evaluation.scenario.canvas
    if run.judged is not None:
        paint = run.judged.paint
        # Its figures are listed only if they are what was painted.
        pattern = pattern if pattern is not None and np.array_equal(raster(pattern), paint) else None
    elif pattern is not None:
        paint = raster(pattern)
    else:
        return None
    size = (canvas.width_m, canvas.length_m) if canvas is not None else None
    return {
        "picture": encoded(on_asphalt(paint, 480, size or (1.0, 1.0)), "PNG"),
        "painted": "" if run.judged is None else PAINTED[run.judged.evaluation.paint],
        "size": f"{size[0]:.1f} × {size[1]:.1f} m" if size else "400 × 400 canvas pixels",
        "share": f"{(paint[..., 3] / 255).mean():.0%}",
        "figures": [] if pattern is None else _figures(pattern, size),
    }


def _figures(pattern: Pattern, size: tuple[float, float] | None) -> list[Fields]:
    scale_x, scale_y, unit = (size[0] / 400, size[1] / 400, "m") if size else (1.0, 1.0, "px")
    digits = 2 if size else 0
    boxes = cast("list[list[float]]", pattern.boxes.tolist())
    colours = cast("list[list[float]]", pattern.colours.tolist())
    rows: list[Fields] = []
    for number, (shape, box, rgb) in enumerate(zip(pattern.shapes, boxes, colours, strict=True), 1):
        x, y, width, length, turned = box
        red, green, blue = (round(255 * channel) for channel in rgb)
        rows.append(
            {
                "number": number,
                "shape": str(shape),
                "at": f"{x * scale_x:.{digits}f}, {y * scale_y:.{digits}f} {unit}",
                "size": f"{width * scale_x:.{digits}f} × {length * scale_y:.{digits}f} {unit}",
                "turned": f"{turned:.0f}°",
                "colour": f"#{red:02x}{green:02x}{blue:02x}",
            }
        )
    return rows


def _attack(run: Run) -> Fields | None:
    attack = run.attack
    if attack is None:
        return None
    count = attack.history.shape[2]
    starts = f"{attack.method.word}: {count} start{'s' if count != 1 else ''}"
    return {
        "chart": charts.search(attack.history, tuple(attack.by_group), attack.objective),
        "objective": attack.objective,
        "shift": f"{attack.surrogate_shift:+.3f}",
        "group": attack.group,
        "groups": [(name, f"{value:+.3f}") for name, value in attack.by_group.items()],
        "how": f"{starts} a group, {len(attack.history)} last steps, {attack.space.figures} figures of the "
        f"{attack.space.family} family, seed {attack.seed}",
        "checks": [asdict(check) for check in attack.checks],
    }


def _foretold(run: Run) -> Fields | None:
    """The recorded world's word against the drive."""
    prediction = run.prediction
    if prediction is None:
        return None
    canvas = run.recordings and run.recordings.canvas
    return {
        "chart": None if canvas is None else charts.foretold(prediction, canvas),
        "predicted": f"{prediction.predicted_m:.2f}",
        "spread": f"{prediction.least_m:.2f} to {prediction.most_m:.2f}",
        "driven": f"{prediction.driven_m:.2f}",
        "error": f"{prediction.error_m:+.2f}",
        "path_error": f"{prediction.path_error_m:.2f}",
        "gap": f"{prediction.gap_m:.2f} m, {np.degrees(prediction.gap_rad):.0f}°",
    }


def _fidelity(judged: Judged | None) -> Fields | None:
    if judged is None or judged.fidelity is None:
        return None
    fidelity, found = judged.fidelity, judged.fidelity.agreement
    shown = np.unique(np.linspace(0, len(fidelity.clean) - 1, SHOWN_COMPOSITES).round().astype(int)).tolist()
    return {
        "frames": found.frames,
        "drive": fidelity.drive,
        "paint_error": f"{found.paint_error:.1f}",
        "elsewhere_error": f"{found.elsewhere_error:.1f}",
        "steer_error": f"{found.steer_error:.3f}",
        "predicted": f"{found.predicted_shift:+.3f}",
        "rendered": f"{found.rendered_shift:+.3f}",
        "shown": [
            {
                "frame": int(fidelity.frame_number[k]),
                "clean": _picture(fidelity.clean[k], lossless=True),
                "composited": _picture(fidelity.composited[k], lossless=True),
                "rendered": _picture(fidelity.rendered[k], lossless=True),
            }
            for k in shown
        ],
    }


def _recorded(run: Run) -> Fields | None:
    if run.drives is None and run.recordings is None:
        return None
    drives = {} if run.drives is None else {each.name: each for each in run.drives.drives}
    calibrated = {} if run.recordings is None else {each.name: each for each in run.recordings.recordings}
    rows: list[Fields] = []
    for name in [*drives, *(name for name in calibrated if name not in drives)]:
        drive, recording = drives.get(name), calibrated.get(name)
        kept = recording or drive
        rows.append(
            {
                "name": name,
                "push": MISSING if kept is None else str(kept.push),
                "frames": MISSING if kept is None else str(len(kept.frames)),
                "aside": MISSING if drive is None else _aside(-drive.offset_m),
                "note": "" if drive is None else drive.note,
            }
        )
    return {"rows": rows, "origin": "" if run.recordings is None else run.recordings.origin}


def _calibration(run: Run) -> Fields | None:
    if run.recordings is None:
        return None
    maps = sum(each.maps is not None for each in run.recordings.recordings)
    facts = [("drives with gain and offset of every pixel", f"{maps} of {len(run.recordings.recordings)}")]
    report = run.calibration
    if report is None:
        return {"facts": facts, "drives": []}
    colour = MISSING if report.colour_residual is None else f"{report.colour_residual:.1f} of 255 levels"
    facts = [("method", report.method), ("colours fit within", colour), *facts]
    return {
        "facts": facts,
        "drives": [
            {
                "name": drive.name,
                "frames": drive.frames,
                "residual": _spread(drive.residual_px),
                "stated": _spread(drive.stated_px),
                "dropped": "; ".join(f"{number}: {reason}" for number, reason in drive.dropped) or "none",
            }
            for drive in report.drives
        ],
    }


def _spread(spread: Spread | None) -> str:
    return MISSING if spread is None else f"{spread.mean:.2f} ({spread.p95:.2f})"


def _costs(run: Run) -> list[Fields]:
    """Simulator calls, seconds and the controller's frames of each stage; None where they were not noted."""
    if run.cost:
        frames = {} if run.attack is None else {"attack": run.attack.cost.controller_frames}
        return [
            {"stage": stage, **asdict(cost), "frames": frames.get(stage)}
            for stage, cost in run.cost.items()
            if cost != StageCost()
        ]
    costs: list[Fields] = []
    if run.drives is not None:
        costs.append({"stage": "record", "simulator_calls": run.drives.calls, "seconds": None, "frames": None})
    if run.calibration is not None:
        # Its own count includes recording.
        calls = run.calibration.calls - (0 if run.drives is None else run.drives.calls)
        costs.append(
            {"stage": "calibrate", "simulator_calls": calls, "seconds": run.calibration.seconds, "frames": None}
        )
    if run.attack is not None:
        cost = run.attack.cost
        costs.append(
            {"stage": "attack", "simulator_calls": 0, "seconds": cost.seconds, "frames": cost.controller_frames}
        )
    if run.judged is not None:
        evaluation = run.judged.evaluation
        costs.append(
            {
                "stage": "evaluate",
                "simulator_calls": evaluation.simulator_calls,
                "seconds": evaluation.seconds,
                "frames": None,
            }
        )
    return costs


def _aside(left_m: float) -> str:
    return f"{abs(left_m):.2f} m {'left' if left_m > 0 else 'right'}" if abs(left_m) >= 0.005 else "on its path"


def _picture(pixels: np.ndarray, *, lossless: bool = False) -> str:
    return encoded(Image.fromarray(pixels), "PNG" if lossless else "JPEG")

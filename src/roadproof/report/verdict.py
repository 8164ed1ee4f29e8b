"""The one sentence a report begins with."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from roadproof.attacks import AttackResult
from roadproof.attacks.driven import Effect
from roadproof.datatypes import Ending
from roadproof.driving.evaluation import Evaluation
from roadproof.driving.intervals import mean_95
from roadproof.driving.speed import speed_in_words
from roadproof.driving.trial import runs_of
from roadproof.report.formatting import UNKNOWN, in_words, mean_in_words
from roadproof.report.run import Run

DEVIATES_M = 0.5
"""A car that is so far aside in some drive, and leaves its lane in none, is said to deviate."""


@dataclass(frozen=True, slots=True)
class Verdict:
    """What came out of a run.

    Args:
        key: "fails", "deviates", "holds", "unfit", "chosen", "predicted" or "recorded".
        title: the verdict in two or three words.
        sentence: the whole finding.
    """

    key: str
    title: str
    sentence: str


class KeyFigure(NamedTuple):
    """One number beside the verdict, with what it is and what to know of it."""

    value: str
    label: str
    note: str


def verdict(run: Run) -> Verdict:
    """What a run shows; without driving it shows a prediction at most."""
    if run.judged is not None:
        evaluation = run.judged.evaluation
        return _predicted_drives(evaluation) if evaluation.predicted else _driven(evaluation)
    if run.attack is not None:
        if run.attack.driven is not None:
            return Verdict("chosen", "Driven to choose, not judged", _chosen(run.attack.driven))
        driven = run.attack.predicted_m is not None or run.attack.predicted_mps is not None
        title = "Predicted, not driven" if driven else "Seen on composited frames, not driven"
        return Verdict("predicted", title, _predicted(run.attack))
    drives = len(run.drives.drives if run.drives else run.recordings.recordings if run.recordings else ())
    return Verdict("recorded", "Not attacked yet", f"{drives} drives are recorded; no pattern was searched yet.")


def _predicted(attack: AttackResult) -> str:
    if attack.predicted_mps is not None:
        return (
            f"Driven in the recorded frames, the pattern makes the car {speed_in_words(attack.predicted_mps)} on "
            "average while the canvas is in view; nobody has driven over it for real yet."
        )
    if attack.predicted_m is not None:
        return (
            f"Driven in the recorded frames, the pattern makes the car deviate by {attack.predicted_m:.2f} m "
            f"({attack.group}); nobody has driven over it for real yet."
        )
    return (
        f"On composited frames the pattern shifts steering by {attack.surrogate_shift:+.3f} a frame "
        f"({attack.group}); nobody has driven over it yet."
    )


def _chosen(effect: Effect) -> str:
    return (
        f"In the drive that chose it the pattern makes the car deviate by {effect.deviation:.2f} m; what chose a "
        "pattern does not say how bad it is: evaluate it from other starts."
    )


def _predicted_drives(evaluation: Evaluation) -> Verdict:
    trials = evaluation.of(traffic=False)
    furthest = max(abs(trial.lateral_m) for trial in trials)
    deviation = float(np.mean([trial.deviation_m for trial in trials]))
    left = [trial.ending for trial in trials if trial.ending == Ending.LEFT_RECORDED]
    more = " or more: it leaves what was recorded" if left else ""
    return Verdict(
        "predicted",
        "Predicted, not driven",
        f"Nothing was driven for real: in pictures made from recorded frames of {evaluation.scenario.name} the pattern "
        f"is predicted to move {evaluation.controller} by up to {furthest:.2f} m{more} (deviation {deviation:.2f} m). "
        "Infractions are not known, since recordings have no map.",
    )


def _driven(evaluation: Evaluation) -> Verdict:
    trials = [*evaluation.of(traffic=False), *evaluation.of(traffic=True)]
    alone = evaluation.of(traffic=False)
    left = sum(trial.leaves_lane for trial in trials)
    furthest = max(abs(trial.lateral_m) for trial in trials)
    who, where, n = evaluation.controller, evaluation.scenario.name, len(trials)
    points = mean_in_words(mean_95(runs_of(trials, lambda trial: trial.points or 0.0)), 1)
    before = mean_in_words(mean_95(runs_of(trials, lambda trial: trial.clean_points or 0.0)), 1)
    if 2 * sum(trial.clean_ending not in ("", Ending.GOAL_REACHED) for trial in alone) > len(alone):
        return Verdict(
            "unfit",
            "Fails without paint",
            f"{who} does not arrive in most drives over the bare road of {where}, so nothing can be blamed on the "
            "pattern; choose a scenario it masters.",
        )
    if 2 * sum(bool(trial.clean_points) for trial in alone) > len(alone):
        return Verdict(
            "unfit",
            "Fails without paint",
            f"{who} commits infractions in most drives over the bare road of {where} ({before} points a drive), so "
            "nothing can be blamed on the pattern; choose a scenario it masters.",
        )
    if left:
        deviations = [trial.deviation_m for trial in trials]
        return Verdict(
            "fails",
            "Fails over the paint",
            f"Over the pattern {who} leaves its lane in {left} of {n} drives of {where}: it deviates by "
            f"{np.median(deviations):.2f} m (median; {min(deviations):.2f} to {max(deviations):.2f}), is up to "
            f"{furthest:.1f} m aside, and a drive costs {points} penalty points instead of {before}.",
        )
    arriving = sum(trial.clean_ending == Ending.GOAL_REACHED for trial in alone)
    if stopped := sum(trial.loses_its_way for trial in alone):
        return Verdict(
            "fails",
            "Stops over the paint",
            f"Over the pattern {who} keeps its lane but does not arrive in {stopped} of {arriving} drives alone on "
            f"{where} in which it arrives over the bare road.",
        )
    if furthest >= DEVIATES_M:
        return Verdict(
            "deviates",
            "Deviates, no infraction",
            f"The pattern moves {who} by up to {furthest:.1f} m on {where}, but no drive of {n} costs more penalty "
            "points than on the bare road.",
        )
    deviation = float(np.mean([trial.deviation_m for trial in alone]))
    return Verdict(
        "holds",
        "Holds its lane",
        f"{who} keeps its path on {where}: at most {furthest:.2f} m aside (deviation {deviation:.2f} m), and in none "
        f"of {n} drives more penalty points than on the bare road.",
    )


def key_figures(run: Run) -> list[KeyFigure]:
    """The numbers beside the verdict; of driving alone, or predicted and called so."""
    if run.judged is None:
        return []
    evaluation = run.judged.evaluation
    predicted = ", predicted" if evaluation.predicted else ""
    alone, traffic = (evaluation.of(traffic=each) for each in (False, True))
    trials = [*alone, *traffic]
    furthest = max(trials, key=lambda trial: abs(trial.lateral_m))
    side = "left" if furthest.lateral_m > 0 else "right"
    deviations = [trial.deviation_m for trial in alone]
    paths = [
        KeyFigure(
            f"{abs(furthest.lateral_m):.2f} m",
            f"furthest from the clean path{predicted}",
            f"to the {side}, {in_words(furthest.weather)}",
        ),
        KeyFigure(
            f"{np.median(deviations):.2f} m",
            f"median deviation{predicted}",
            f"the paper’s measure, {min(deviations):.2f} to {max(deviations):.2f} over {len(alone)} drives alone",
        ),
    ]
    if evaluation.predicted:
        return [*paths, KeyFigure(UNKNOWN, "infractions", "recordings have no map")]
    failed, before = sum(bool(t.points) for t in trials), sum(bool(t.clean_points) for t in trials)
    points, clean_points = zip(*((t.points or 0.0, t.clean_points or 0.0) for t in traffic or alone), strict=True)
    return [
        *paths,
        KeyFigure(
            f"{np.mean(points):.1f}",
            "penalty points a drive",
            f"{np.mean(clean_points):.1f} on the bare road{', in traffic' if traffic else ''}",
        ),
        KeyFigure(
            f"{sum(t.leaves_lane for t in trials)} of {len(trials)}",
            "drives leave the lane",
            f"{failed} with infractions, {before} on the bare road",
        ),
    ]

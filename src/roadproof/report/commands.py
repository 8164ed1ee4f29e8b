"""Which commands make a run again."""

from __future__ import annotations

import shlex
from dataclasses import astuple

from roadproof.attacks import AttackResult
from roadproof.driving.evaluation import Evaluation
from roadproof.report.run import Run
from roadproof.simulators.protocol import PaintKind


def commands_of(run: Run) -> tuple[str, ...]:
    """The commands kept in the run, or else those that its results tell of."""
    if run.commands:
        return run.commands
    folder = run.folder
    lines: list[list[str]] = []
    if run.attack is not None:
        who = run.judged.evaluation.controller if run.judged is not None else "CONTROLLER"
        lines.append(["roadproof", "attack", str(folder / "recordings"), "--controller", who, *_attack(run.attack)])
        lines[-1] += ["--out", str(folder / "attack")]
    if run.judged is not None:
        paint = folder / "attack" / "pattern.json" if run.attack is not None else folder / "evaluation" / "paint.png"
        judged = run.judged.evaluation
        options = _foresee(run, judged) if judged.predicted else _evaluate(judged)
        lines.append(["roadproof", "evaluate", str(paint), *options])
        lines[-1] += ["--out", str(folder / "evaluation")]
    lines.append(["roadproof", "report", str(folder)])
    return tuple(map(shlex.join, lines))


def _attack(attack: AttackResult) -> list[str]:
    options = ["--figures", str(attack.space.figures), "--family", attack.space.family]
    options += ["--groups", ",".join(attack.by_group), "--method", attack.method.word]
    for name in ("iterations", "restarts", "masks", "calls"):
        value = getattr(attack.method, name, None)
        options += [f"--{name}", str(value)] if value is not None else []
    return [*options, "--seed", str(attack.seed)]


def _evaluate(evaluation: Evaluation) -> list[str]:
    options = ["--scenario", evaluation.scenario.name, "--controller", evaluation.controller]
    options += ["--weathers", ",".join(evaluation.weathers), *_starts(evaluation), "--runs", str(evaluation.runs)]
    options += ["--cars", str(evaluation.cars), "--pedestrians", str(evaluation.pedestrians)]
    # Where a server stood is nobody's to keep; that it was one is.
    where = (
        ["--simulator", f"carla://HOST:PORT?paint={evaluation.paint}"]
        if evaluation.paint is not PaintKind.RENDERED
        else []
    )
    return [*options, *_random(evaluation), *where]


def _foresee(run: Run, evaluation: Evaluation) -> list[str]:
    """Options of an evaluation in recordings, which say scenario and weather; RECORDINGS where the run has none."""
    recordings = str(run.folder) if run.recordings is not None else "RECORDINGS"
    options = [*_starts(evaluation), *_random(evaluation)]
    return ["--controller", evaluation.controller, *options, "--simulator", f"recorded:{recordings}"]


def _starts(evaluation: Evaluation) -> list[str]:
    if not evaluation.starts:
        return ["--starts", "0"]
    among = map(str, astuple(evaluation.start_range))
    return ["--starts", str(evaluation.starts), "--start-range", *among]


def _random(evaluation: Evaluation) -> list[str]:
    random = {trial.pattern for trial in evaluation.trials if trial.pattern.startswith("random")}
    return ["--random", str(len(random)), "--seed", str(evaluation.seed)]

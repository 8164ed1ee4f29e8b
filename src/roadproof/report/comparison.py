"""Several runs beside each other on one page: before and after a fix, two controllers, two ways of searching.

write_comparison([Path("out/before"), Path("out/after")], Path("out/compare.html"))
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from roadproof.datatypes import Weather
from roadproof.driving.evaluation import ATTACK, Evaluation, EvaluationRow
from roadproof.driving.intervals import Estimate, mean_95
from roadproof.driving.trial import Trial, runs_of
from roadproof.errors import RoadproofError
from roadproof.io.files import AnyPath, as_path, write_text
from roadproof.io.html import encoded
from roadproof.report import charts
from roadproof.report.html import rendered
from roadproof.report.road_view import on_asphalt
from roadproof.report.run import ShownEvaluation, read_run
from roadproof.report.top_view import top_view
from roadproof.report.verdict import Verdict, verdict

MOST_RUNS = 8


@dataclass(frozen=True, slots=True, eq=False)
class Compared:
    """One run of a comparison.

    Args:
        name: the name of the run: its folder's name, with the folders above as far as others have the same.
        judged: the evaluation of the run.
        verdict: the verdict on the run.
        alone: the run's drives over the pattern, alone on the road, in each weather, and in all together under None.
        change: mean change of the deviation against the first run over drives alone on the road, metres; None for the
            first run, where no drive has weather and start in common with one of the first run's, and where one run is
            driven and the other predicted.
    """

    name: str
    judged: ShownEvaluation
    verdict: Verdict
    alone: dict[Weather | None, EvaluationRow]
    change: Estimate | None

    @property
    def predicted(self) -> bool:
        """Whether the run's drives are predicted."""
        return self.judged.evaluation.predicted

    @property
    def whole(self) -> EvaluationRow:
        """The run's drives in all weathers together; in the one weather, where there is one alone."""
        return self.alone.get(None) or next(iter(self.alone.values()))


def compared(folders: Sequence[AnyPath]) -> tuple[Compared, ...]:
    """Read runs that are to be compared.

    Args:
        folders: two run folders or more, each with an evaluation; the first is what the others are compared with.

    Raises:
        RoadproofError: only one run is given or more than `MOST_RUNS`, one is given twice, one has no evaluation, or a
            stage is damaged; the message names it.
    """
    paths = [as_path(folder) for folder in folders]
    if not 2 <= len(paths) <= MOST_RUNS:
        raise RoadproofError(f"{len(paths)} runs to compare, expected 2 to {MOST_RUNS}")
    twice = [path for path in paths if [each.resolve() for each in paths].count(path.resolve()) > 1]
    if twice:
        raise RoadproofError(f"{twice[0]} is given twice; compare different runs")
    runs = [(path, read_run(path)) for path in paths]
    found: list[Compared] = []
    for path, run in runs:
        if run.judged is None:
            raise RoadproofError(f"{path} has no evaluation, so there is nothing to compare; finish it, or evaluate")
        evaluation = run.judged.evaluation
        rows = {row.weather: row for row in evaluation.rows() if row.pattern == ATTACK and not row.traffic}
        first = found[0].judged.evaluation if found else None
        alike = first is not None and _kind(first) == _kind(evaluation)
        change = _change(first.of(traffic=False), evaluation.of(traffic=False)) if first and alike else None
        found.append(Compared(_name(path, paths), run.judged, verdict(run), rows, change))
    return tuple(found)


def write_comparison(folders: Sequence[AnyPath], page: AnyPath) -> tuple[Compared, ...]:
    """Write one page on several runs; it needs no other file.

    Args:
        folders: two run folders or more, each with an evaluation; the first is what the others are compared with.
        page: the HTML file to write.

    Returns:
        The runs as they are compared, in the order of the folders.

    Raises:
        RoadproofError: as `compared` raises it.
        OutputError: the page cannot be written.
    """
    runs = compared(folders)
    judged = [each.judged for each in runs]
    weathers = list(dict.fromkeys(weather for each in judged for weather in each.evaluation.weathers))
    first = judged[0].evaluation.scenario
    kinds = sorted({each.predicted for each in runs})
    same_place = all(each.evaluation.scenario.canvas == first.canvas for each in judged)
    text = rendered(
        "compare.html.jinja",
        runs=runs,
        kinds=kinds,
        weathers=weathers,
        cautions=_cautions(runs, same_place=same_place),
        offsets=charts.offsets([(each.name, each.judged.clean, each.judged.painted) for each in runs], first.canvas)
        if same_place and len(kinds) == 1
        else None,
        patterns=[encoded(on_asphalt(each.paint, 360, each.evaluation.scenario.canvas), "PNG") for each in judged],
        above=[
            top_view(each.evaluation.scenario, each.paint, each.clean, each.painted, f"above-{number}")
            for number, each in enumerate(judged)
        ],
    )
    write_text(as_path(page), text)
    return runs


def _name(path: Path, paths: Sequence[Path]) -> str:
    """The last parts of a path, as many as it takes to tell it from the others."""
    own, *others = (each.resolve().parts for each in (path, *(each for each in paths if each != path)))
    depth = next(n for n in range(1, len(own) + 1) if all(other[-n:] != own[-n:] for other in others))
    return Path(*own[-depth:]).as_posix()


def _kind(evaluation: Evaluation) -> tuple[object, ...]:
    """What two runs have in common whose drives are compared one by one."""
    return evaluation.predicted, evaluation.scenario.canvas, evaluation.scenario.start


def _change(before: Sequence[Trial], after: Sequence[Trial]) -> Estimate | None:
    """The mean change of the deviation over drives that have all but pattern and controller in common."""
    known = {_conditions(trial): trial.deviation_m for trial in before}
    shared = [trial for trial in after if _conditions(trial) in known]
    return mean_95(runs_of(shared, lambda trial: trial.deviation_m - known[_conditions(trial)])) if shared else None


def _conditions(trial: Trial) -> tuple[object, ...]:
    return trial.weather, trial.traffic, trial.seed if trial.traffic else 0, trial.start


def _all_conditions(evaluation: Evaluation) -> tuple[object, ...]:
    others = (evaluation.cars, evaluation.pedestrians) if evaluation.of(traffic=True) else ()
    return frozenset(map(_conditions, evaluation.trials)), others


def _cautions(runs: Sequence[Compared], *, same_place: bool) -> list[str]:
    """Why numbers beside each other may not be alike."""
    said: list[str] = []
    if not same_place:
        said.append("They are of different stretches of road: how far a car deviates depends on the road too.")
    if len({each.predicted for each in runs}) > 1:
        said.append("Some were driven and some only predicted in recordings: their metres are not of one kind.")
    if len({_all_conditions(each.judged.evaluation) for each in runs}) > 1:
        said.append(
            "They were not judged in the same weathers, from the same starts, with the same others on the road."
        )
    patterns = len({each.judged.paint.tobytes() for each in runs})
    if patterns == len(runs):
        said.append("Each was judged over a pattern of its own.")
    elif patterns > 1:
        said.append("They were not all judged over the same pattern.")
    return said

"""What each method of a study found, and what finding it took: over all scenarios, and scenario by scenario."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from roadproof.driving.intervals import Estimate
from roadproof.io.text import count_of
from roadproof.report.formatting import MISSING, in_words
from roadproof.study.folder import pandas
from roadproof.study.results import DEVIATION, JOB, LEFT_LANE, Block, Results
from roadproof.study.rows import Frame
from roadproof.study.statistics import EQUAL, Values, mean_over_scenarios
from roadproof.study.table import Cell, Heading, Table, headings, marked, share_of
from roadproof.study.table_notes import missing, table_note


def methods_table(results: Results) -> Table:
    """What every method found, and what finding it took: simulator calls and seconds of the search."""
    blocks = results.overall
    lane = replace(blocks[0], metric=LEFT_LANE)
    names = [method.name for method in results.methods]
    rows: list[tuple[Cell, ...]] = []
    for figures in results.figures:
        shown = [_marked([results.values(block, name, figures) for name in names]) for block in blocks]
        for number, name in enumerate(names):
            searches = results.drives[(results.drives["method"] == name) & (results.drives["figures"] == figures)]
            rows.append((
                figures if number == 0 else "",
                name,
                str(len(searches.drop_duplicates(JOB))),
                *_costs(searches),
                *(column[number] for column in shown),
                _spread(results.drives_of(blocks[0], [name], figures)["deviation_m"]),
                share_of(mean_over_scenarios(results.values(lane, name, figures))),
            ))  # fmt: skip
    said = (
        "Simulator calls and seconds: mean of one search, without judging its pattern. Median "
        "and quartiles: over all drives, each from a start of its own. Leave the lane: share of those drives."
    )
    columns = ("patterns", "simulator calls", "seconds", "deviation", "penalty", "median", "leave the lane")
    return Table(
        name="methods",
        title=f"What each method found and what it cost, {in_words(results.home)}",
        note=table_note(results, blocks, names, said, compared=False),
        header=(
            (*headings("", "", ""), Heading("Search", 2), Heading("Found", 4)),
            headings("K", "method", *columns),
        ),
        rows=tuple(rows),
        left=2,
    )


@dataclass(frozen=True, slots=True, eq=False)
class _Found:
    """What the methods found in one scenario, or in several: their drives, and medians by weather and method."""

    scenario: str
    drives: Sequence[Frame]
    medians: Sequence[Sequence[Estimate | None]]

    @property
    def is_whole(self) -> bool:
        """Whether every method was driven in every weather, and in each with the seeds of the others."""
        driven = {frozenset(zip(each["seed"], each["weather"], strict=True)) for each in self.drives}
        return len(driven) == 1 and all(each is not None for row in self.medians for each in row)


def scenarios_table(results: Results) -> Table:
    """The same scenario by scenario, in every weather: medians over drives, and how many of these left the lane.

    A last block for each K has the means of those medians over the scenarios that every method came to the end of with
    the same seeds; only these are compared.
    """
    traffic, names = not results.has(traffic=False), [method.name for method in results.methods]
    driven = results.drives[results.drives["traffic"] == traffic]
    rows, compared = list[tuple[Cell, ...]](), list[Sequence[float]]()
    for figures in results.figures:
        of_k = driven[driven["figures"] == figures]
        found = [_found_in(scenario, of_k[of_k["scenario"] == scenario], results) for scenario in results.kinds]
        whole = [each for each in found if each.is_whole]
        values = np.array([[[each.value for each in row if each] for row in one.medians] for one in whole])
        compared += values.reshape(-1, len(names)).tolist() if whole else []
        if len(whole) > 1:
            drives = [pandas().concat([one.drives[number] for one in whole]) for number in range(len(names))]
            means = [[Estimate(mean, None, None, len(whole)) for mean in row] for row in values.mean(0).tolist()]
            found.append(_Found(f"mean of {len(whole)}", drives, means))
        for each in found:
            rows += _rows_of(each, figures, names)
    home, *others = map(in_words, results.weathers)
    most = [sum(row[number] >= max(row) - EQUAL for row in compared) for number in range(len(names))]
    said = [
        f"Deviation in m, {'in traffic' if traffic else 'alone on the road'}; all of it driven.",
        f"Medians over starts, their mean over {count_of(len(results.seeds), 'seed')}, least and most drive at {home}.",
        "Simulator calls and seconds: mean of one search, without judging its pattern.",
        "Leave the lane, and penalty in points (median): of the same drives, all weathers together.",
    ]
    if len(names) > 1 and compared:
        wins = ", ".join(f"{name} {count}" for name, count in zip(names, most, strict=True))
        said.append(f"Highest, or as high, in so many of {len(compared)} cases of scenario, K and weather: {wins}.")
    blocks = [Block("", DEVIATION, weather, traffic) for weather in results.weathers]
    return Table(
        name="scenarios",
        title="What each method found, scenario by scenario",
        note=" ".join([*said, *missing(results, blocks, names)]),
        header=(
            (*headings("", "", ""), Heading("Search", 2), Heading("Deviation", len(blocks)), *headings("", "")),
            headings("K", "scenario", "method", "calls", "seconds", home, *others, "leave the lane", "penalty"),
        ),
        rows=tuple(rows),
        left=3,
    )


def _found_in(scenario: str, drives: Frame, results: Results) -> _Found:
    by_method = [drives[drives["method"] == method.name] for method in results.methods]
    return _Found(
        scenario,
        by_method,
        [[_median(each, weather, results.home) for each in by_method] for weather in results.weathers],
    )


def _rows_of(found: _Found, figures: str, names: Sequence[str]) -> list[tuple[Cell, ...]]:
    """A row a method; none where no method was driven, and no mark where their drives are not of the same cases."""
    columns = [marked(each, compared=found.is_whole) for each in found.medians]
    rows = list[tuple[Cell, ...]]()
    for number, (name, drives) in enumerate(zip(names, found.drives, strict=True)):
        told = f"{drives['left_lane'].sum():.0f} of {len(drives)}", f"{drives['points'].median():g}"
        named = (figures, found.scenario) if number == 0 else ("", "")
        after = (MISSING, MISSING) if drives.empty else told
        rows.append((*named, name, *_costs(drives), *(column[number] for column in columns), *after))
    return [] if all(drives.empty for drives in found.drives) else rows


def _median(drives: Frame, weather: str, home: str) -> Estimate | None:
    """The median deviation in a weather, between the least and the most where patterns were found.

    It is the mean over seeds of each one's median: of two patterns, one of which does nothing, the median of all drives
    would lie where none is.
    """
    there = drives[drives["weather"] == weather]
    if there.empty:
        return None
    values, middle = there["deviation_m"], there.groupby("seed")["deviation_m"].median().mean()
    ends = (float(values.min()), float(values.max())) if weather == home else (None, None)
    return Estimate(float(middle), *ends, len(values))


def _marked(values: Sequence[Values]) -> list[Cell]:
    """Means over scenarios, of which the highest is marked where all methods have the same cases."""
    alike = len({frozenset(each.index) for each in values}) == 1
    return marked([mean_over_scenarios(each) for each in values], compared=alike)


def _costs(drives: Frame) -> tuple[str, str]:
    """Simulator calls and seconds of a search: the mean over the jobs of some drives."""
    jobs = drives.drop_duplicates(JOB)
    return _rounded(jobs["search_calls"]), _rounded(jobs["search_seconds"])


def _spread(values: Values) -> str:
    """Median and quartiles."""
    if values.empty:
        return MISSING
    low, middle, high = values.quantile([0.25, 0.5, 0.75])
    return f"{middle:.2f} ({low:.2f} to {high:.2f})"


def _rounded(values: Values) -> str:
    mean = values.mean()
    return MISSING if values.empty else f"{mean:.0f}" if mean >= 10 or mean == int(mean) else f"{mean:.1f}"

"""Patterns found against one controller and driven by others: a matrix as a table and as a heat map."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from matplotlib.figure import Figure

from roadproof.driving.intervals import Mean
from roadproof.errors import StudyError
from roadproof.report.formatting import MISSING
from roadproof.report.study.blocks import DEVIATION, Metric
from roadproof.report.study.charts import INK, MUTED, Picture, plain
from roadproof.report.study.results import Record
from roadproof.report.study.statistics import Case, mean_over_scenarios
from roadproof.report.study.table import Cell, Estimate, Heading, Table, slug

_COLUMNS = ("found_on", "driven_by", "scenario", "figures", "method", "seed", "deviation_m", "points")


@dataclass(frozen=True, slots=True)
class Transfer:
    """Means of one metric over all patterns of each pair of controllers.

    Args:
        metric: which.
        found_on: against whom the patterns were found; the matrix' rows.
        driven_by: who drove over them; its columns.
        means: of each pair; a pair that was not driven is not there.
    """

    metric: Metric
    found_on: tuple[str, ...]
    driven_by: tuple[str, ...]
    means: dict[tuple[str, str], Mean]


def transfer_of(records: Iterable[Record], metric: Metric = DEVIATION) -> Transfer:
    """The matrix of a transfer study.

    Args:
        records: rows with found_on, driven_by, scenario, figures, method, seed, deviation_m, points; one a drive.
        metric: deviation or penalty.

    Raises:
        StudyError: there is no row, a column is missing, or a number is not finite.
    """
    drives: dict[tuple[str, str], dict[Case, list[float]]] = {}
    for row in records:
        for column in _COLUMNS:
            if column not in row:
                raise StudyError(f"the transfer's rows have no column {column!r}, expected {', '.join(_COLUMNS)}")
        value = float(row[metric.field])
        if not np.isfinite(value):
            raise StudyError(f"{metric.field} of {row['scenario']} is {value}, expected a finite number")
        pair = (str(row["found_on"]), str(row["driven_by"]))
        case = tuple(str(row[column]) for column in ("scenario", "figures", "method", "seed"))
        drives.setdefault(pair, {}).setdefault(case, []).append(value)
    if not drives:
        raise StudyError("the transfer has no rows; drive some patterns first")
    means = {
        pair: mean
        for pair, cases in drives.items()
        if (mean := mean_over_scenarios({case: float(np.mean(values)) for case, values in cases.items()})) is not None
    }
    # Controllers that stand on both sides first and in one order, so that the diagonal is their own patterns.
    found = dict.fromkeys(pair[0] for pair in drives)
    others = [name for name in dict.fromkeys(pair[1] for pair in drives) if name not in found]
    driven = [name for name in found if any(pair[1] == name for pair in drives)]
    return Transfer(metric, tuple(found), (*driven, *others), means)


def transfer_table(transfer: Transfer) -> Table:
    """The matrix with intervals; each controller's worst pattern source in bold, where there are several."""
    several = len(transfer.found_on) > 1
    worst = {
        driver: max(mean.value for (_, by), mean in transfer.means.items() if by == driver)
        for driver in transfer.driven_by
    }

    def cell(found_on: str, driver: str) -> Cell:
        mean = transfer.means.get((found_on, driver))
        return MISSING if mean is None else Estimate(mean, best=several and mean.value == worst[driver])

    counts = {mean.count for mean in transfer.means.values()}
    missing = len(transfer.found_on) * len(transfer.driven_by) - len(transfer.means)
    return Table(
        name=f"transfer-{slug(transfer.metric.title)}",
        title=f"Transfer: {transfer.metric.title.lower()} of patterns found against one controller, driven by another",
        note=f"{transfer.metric.title} in {transfer.metric.unit}, driven; means over "
        f"{' to '.join(str(each) for each in sorted({min(counts), max(counts)}))} patterns a cell with 95 % bootstrap "
        "intervals over scenarios."
        + (" The highest of each driver in bold." if several else "")
        + (f" {missing} pairs were not driven." if missing else ""),
        header=(
            (Heading(""), Heading("driven by", len(transfer.driven_by))),
            (Heading("found on"), *map(Heading, transfer.driven_by)),
        ),
        rows=tuple((found, *(cell(found, driver) for driver in transfer.driven_by)) for found in transfer.found_on),
    )


def transfer_map(transfer: Transfer) -> Picture:
    """The matrix as a heat map; colour and number say the same."""
    values = np.full((len(transfer.found_on), len(transfer.driven_by)), np.nan)
    for (found, driver), mean in transfer.means.items():
        values[transfer.found_on.index(found), transfer.driven_by.index(driver)] = mean.value
    top = max(float(np.nanmax(values)), 1e-6)
    rows, columns = values.shape
    figure = Figure(figsize=(1.35 * columns + 2.4, 0.85 * rows + 1.5), layout="constrained")
    axes = figure.add_subplot()
    axes.imshow(np.ma.masked_invalid(values), cmap="cividis", vmin=0.0, vmax=top)
    for row, column in np.ndindex(rows, columns):
        value = float(values[row, column])
        ink = MUTED if np.isnan(value) else "white" if value < 0.6 * top else "black"
        text = MISSING if np.isnan(value) else f"{value:.2f}"
        axes.text(column, row, text, ha="center", va="center", color=ink, fontsize=11)
    axes.set_xticks(range(columns), [plain(name) for name in transfer.driven_by], rotation=25, ha="left")
    axes.set_yticks(range(rows), [plain(name) for name in transfer.found_on])
    axes.xaxis.set_ticks_position("top")
    axes.xaxis.set_label_position("top")
    axes.set_xlabel("driven by", color=MUTED)
    axes.set_ylabel("pattern found on", color=MUTED)
    axes.tick_params(length=0, labelsize=9.5, labelcolor=INK)
    axes.spines[:].set_visible(False)
    title = transfer.metric.title
    return Picture(
        f"transfer-{slug(title)}",
        f"{title} in {transfer.metric.unit} of patterns found against one controller (rows) and driven by another "
        "(columns), driven; means over all patterns of a pair.",
        figure,
    )

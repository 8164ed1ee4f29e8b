"""Patterns found against one controller and driven by others: a matrix as a table and as a heat map."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from matplotlib.figure import Figure

from roadproof.driving.intervals import Mean
from roadproof.errors import StudyError
from roadproof.report.words import MISSING
from roadproof.study.charts import INK, MUTED, Picture, plain
from roadproof.study.results import DEVIATION, JOB, Metric, check_finite
from roadproof.study.rows import Frame
from roadproof.study.statistics import mean_over_scenarios
from roadproof.study.table import Cell, Estimate, Heading, Table, headings, slug


@dataclass(frozen=True, slots=True)
class TransferMatrix:
    """Means of one metric over all patterns of each pair of controllers.

    Args:
        metric: what they are means of.
        found_on: against whom the patterns were found; the matrix' rows.
        driven_by: who drove over them; its columns.
        means: of each pair; a pair that was not driven is not there.
    """

    metric: Metric
    found_on: tuple[str, ...]
    driven_by: tuple[str, ...]
    means: dict[tuple[str, str], Mean]


def transfer_matrix(rows: Frame, metric: Metric = DEVIATION) -> TransferMatrix:
    """The matrix of a transfer study.

    Args:
        rows: of transfer.parquet (`rows.TransferRow`), one a drive.
        metric: deviation or penalty.

    Raises:
        StudyError: there is no row, a column is missing, or a number is not finite.
    """
    if rows.empty:
        raise StudyError("the transfer has no rows; drive some patterns first")
    pairs = ["found_on", "controller"]
    for column in (*pairs, *JOB, metric.column):
        if column not in rows:
            raise StudyError(f"the transfer's rows have no column {column!r}; run the transfer again")
    check_finite(rows, metric.column)
    patterns = rows.groupby([*pairs, *JOB], sort=False)[metric.column].mean()
    means = {pair: mean_over_scenarios(own.droplevel(pairs)) for pair, own in patterns.groupby(level=pairs, sort=False)}
    # Controllers that stand on both sides first and in one order, so that the diagonal is their own patterns.
    found, drivers = list(rows["found_on"].unique()), list(rows["controller"].unique())
    both = [name for name in found if name in drivers]
    driven = (*both, *(name for name in drivers if name not in found))
    return TransferMatrix(metric, tuple(found), driven, {pair: mean for pair, mean in means.items() if mean})


def transfer_table(matrix: TransferMatrix) -> Table:
    """The matrix with intervals; each controller's worst pattern source in bold, where there are several."""
    several = len(matrix.found_on) > 1
    worst = {
        driver: max(mean.value for (_, by), mean in matrix.means.items() if by == driver) for driver in matrix.driven_by
    }

    def cell(found_on: str, driver: str) -> Cell:
        mean = matrix.means.get((found_on, driver))
        return MISSING if mean is None else Estimate(mean, best=several and mean.value == worst[driver])

    metric, counts = matrix.metric, {mean.count for mean in matrix.means.values()}
    missing = len(matrix.found_on) * len(matrix.driven_by) - len(matrix.means)
    return Table(
        name=f"transfer-{slug(metric.title)}",
        title=f"Transfer: {metric.title.lower()} of patterns found against one controller, driven by another",
        note=f"{metric.title} in {metric.unit}, driven; means over "
        f"{' to '.join(str(each) for each in sorted({min(counts), max(counts)}))} patterns a cell with 95 % bootstrap "
        "intervals over scenarios."
        + (" The highest of each driver in bold." if several else "")
        + (f" {missing} pairs were not driven." if missing else ""),
        header=(
            (Heading(""), Heading("driven by", len(matrix.driven_by))),
            headings("found on", *matrix.driven_by),
        ),
        rows=tuple((found, *(cell(found, driver) for driver in matrix.driven_by)) for found in matrix.found_on),
    )


def transfer_map(matrix: TransferMatrix) -> Picture:
    """The matrix as a heat map; colour and number say the same."""
    values = np.full((len(matrix.found_on), len(matrix.driven_by)), np.nan)
    for (found, driver), mean in matrix.means.items():
        values[matrix.found_on.index(found), matrix.driven_by.index(driver)] = mean.value
    top = max(float(np.nanmax(values)), 1e-6)
    rows, columns = values.shape
    figure = Figure(figsize=(1.35 * columns + 2.4, 0.85 * rows + 1.5), layout="constrained")
    axes = figure.add_subplot()
    axes.imshow(np.ma.masked_invalid(values), cmap="cividis", vmin=0.0, vmax=top)
    for (row, column), value in np.ndenumerate(values):
        ink = MUTED if np.isnan(value) else "white" if value < 0.6 * top else "black"
        text = MISSING if np.isnan(value) else f"{value:.2f}"
        axes.text(column, row, text, ha="center", va="center", color=ink, fontsize=11)
    axes.set_xticks(range(columns), [plain(name) for name in matrix.driven_by], rotation=25, ha="left")
    axes.set_yticks(range(rows), [plain(name) for name in matrix.found_on])
    axes.xaxis.set_ticks_position("top")
    axes.xaxis.set_label_position("top")
    axes.set_xlabel("driven by", color=MUTED)
    axes.set_ylabel("pattern found on", color=MUTED)
    axes.tick_params(length=0, labelsize=9.5, labelcolor=INK)
    axes.spines[:].set_visible(False)
    title = matrix.metric.title
    return Picture(
        f"transfer-{slug(title)}",
        f"{title} in {matrix.metric.unit} of patterns found against one controller (rows) and driven by another "
        "(columns), driven; means over all patterns of a pair.",
        figure,
    )

"""Patterns found against one controller and driven by others: a matrix as a table and as a heat map."""

from __future__ import annotations

import numpy as np
from matplotlib.figure import Figure

from roadproof.driving.intervals import Estimate
from roadproof.errors import StudyError
from roadproof.report.formatting import MISSING, plain
from roadproof.study.charts import INK, MUTED, Picture
from roadproof.study.results import DEVIATION, JOB, Metric, check_finite, check_names
from roadproof.study.rows import Frame, made_by_all
from roadproof.study.statistics import mean_over_scenarios
from roadproof.study.table import Cell, Heading, Number, Table, headings, slug
from roadproof.study.table_notes import intervals_over

_PAIRS = ["found_on", "controller"]


def transfer_table(rows: Frame, metric: Metric = DEVIATION) -> Table:
    """The matrix with intervals; each controller's worst pattern source in bold, where there are several.

    Args:
        rows: the rows of transfer.parquet (`rows.TransferRow`), one a drive.
        metric: the metric that the matrix holds, deviation or penalty.

    Raises:
        StudyError: there is no row, a column is missing, or a number is not finite.
    """
    matrix = _matrix(rows, metric)
    found_on, driven_by = list(matrix.index), list(matrix.columns)
    means = [mean for mean in matrix.to_numpy().flat if mean is not None]
    several, worst = len(found_on) > 1, _values(matrix).max(axis=0)

    def cell(mean: Estimate | None, driver: str) -> Cell:
        return MISSING if mean is None else Number(mean, best=several and bool(mean.value == worst[driver]))

    counts, missing = sorted({mean.count for mean in means}), matrix.size - len(means)
    fewest = int(shared_drives(rows).groupby("found_on")["scenario"].nunique().min())
    return Table(
        name=f"transfer-{slug(metric.title)}",
        title=f"Transfer: {metric.title.lower()} of patterns found against one controller, driven by another",
        note=f"{metric.title} in {metric.unit}, driven; means over "
        f"{' to '.join(map(str, dict.fromkeys((counts[0], counts[-1]))))} patterns a cell, over the drives that "
        f"all controllers of its row made,{intervals_over(fewest)}."
        + (" The highest of each driver in bold." if several else "")
        + (f" {missing} pairs were not driven." if missing else ""),
        header=((Heading(""), Heading("driven by", len(driven_by))), headings("found on", *driven_by)),
        rows=tuple((name, *(cell(matrix.at[name, driver], driver) for driver in driven_by)) for name in found_on),
    )


def transfer_map(rows: Frame, metric: Metric = DEVIATION) -> Picture:
    """The matrix as a heat map; colour and number say the same. Arguments and errors are those of `transfer_table`."""
    matrix = _matrix(rows, metric)
    values = _values(matrix).to_numpy()
    top = max(float(np.nanmax(values)), 1e-6)
    height, width = values.shape
    figure = Figure(figsize=(1.35 * width + 2.4, 0.85 * height + 1.5), layout="constrained")
    axes = figure.add_subplot()
    axes.imshow(np.ma.masked_invalid(values), cmap="cividis", vmin=0.0, vmax=top)
    for (row, column), value in np.ndenumerate(values):
        ink = MUTED if np.isnan(value) else "white" if value < 0.6 * top else "black"
        text = MISSING if np.isnan(value) else f"{value:.2f}"
        axes.text(column, row, text, ha="center", va="center", color=ink, fontsize=11)
    axes.set_xticks(range(width), map(plain, matrix.columns), rotation=25, ha="left")
    axes.set_yticks(range(height), map(plain, matrix.index))
    axes.xaxis.set_ticks_position("top")
    axes.xaxis.set_label_position("top")
    axes.set_xlabel("driven by", color=MUTED)
    axes.set_ylabel("pattern found on", color=MUTED)
    axes.tick_params(length=0, labelsize=9.5, labelcolor=INK)
    axes.spines[:].set_visible(False)
    return Picture(
        f"transfer-{slug(metric.title)}",
        f"{metric.title} in {metric.unit} of patterns found against one controller (rows) and driven by another "
        "(columns), driven; means over the drives that all controllers of a row made.",
        figure,
    )


def shared_drives(rows: Frame) -> Frame:
    """The rows of a transfer that every controller made, which alone are compared.

    Raises:
        StudyError: there is no row, or a column is missing.
    """
    if rows.empty:
        raise StudyError("the transfer has no rows; drive some patterns first")
    for column in (*_PAIRS, *JOB):
        if column not in rows:
            raise StudyError(f"the transfer's rows have no column {column!r}; run the transfer again")
    check_names(rows, _PAIRS)
    return made_by_all(rows)


def _matrix(rows: Frame, metric: Metric) -> Frame:
    """Means over patterns: a row for whom they were found against, a column for who drove; None where nobody.

    All cells of a row are over the same drives, those that every controller in it made.
    """
    shared = shared_drives(rows)
    if shared.empty:
        raise StudyError("no pattern of the transfer was driven over by every controller; leave the transfer out")
    if metric.column not in shared:
        raise StudyError(f"the transfer's rows have no column {metric.column!r}; run the transfer again")
    check_finite(rows, metric.column)
    patterns = shared.groupby([*JOB, *_PAIRS], sort=False)[metric.column].mean()
    means = patterns.groupby(level=_PAIRS, sort=False).apply(mean_over_scenarios)
    # Controllers that stand on both sides first and in one order, so that the diagonal is their own patterns.
    found, drivers = list(rows["found_on"].unique()), list(rows["controller"].unique())
    driven = [*(name for name in found if name in drivers), *(name for name in drivers if name not in found)]
    return means.unstack("controller", fill_value=None).reindex(index=found, columns=driven).replace({np.nan: None})


def _values(matrix: Frame) -> Frame:
    def value(mean: Estimate | None) -> float:
        return np.nan if mean is None else mean.value

    return matrix.map(value).astype(float)

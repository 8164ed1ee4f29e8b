"""What came of a study, in a few lines."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from statistics import fmean
from typing import Any, TypeAlias

Record: TypeAlias = Mapping[str, Any]


def summary(rows: Iterable[Record]) -> tuple[str, ...]:
    """A line for each method: means over its jobs, driven alone in the weather the patterns were found in.

    Args:
        rows: of a study, see `study.job`.
    """
    good = [row for row in rows if not _failed(row)]
    alone = [row for row in good if not row["traffic"] and row["weather"] == good[0]["weather"]]
    lines: list[str] = []
    for method in dict.fromkeys(str(row["method"]) for row in alone):
        own = [row for row in alone if row["method"] == method]
        deviation_m, calls, seconds = (
            fmean(float(row[name]) for row in own) for name in ("deviation_m", "search_calls", "search_seconds")
        )
        lines.append(
            f"{method}: {deviation_m:.2f} m deviation, alone in {own[0]['weather']}; found with {calls:.0f} simulator "
            f"calls in {seconds:.0f} s"
        )
    return tuple(lines)


def failures(rows: Iterable[Record]) -> tuple[str, ...]:
    """A line for each job that failed."""
    return tuple(
        f"{row['scenario']}, K = {row['figures']}, {row['method']}, seed {row['seed']}: {row['error']}"
        for row in rows
        if _failed(row)
    )


def matrix(rows: Iterable[Record]) -> tuple[str, ...]:
    """A line for each method and controller of a transfer: the mean deviation."""
    found: dict[tuple[str, str, str], list[float]] = {}
    for row in rows:
        who = (str(row["method"]), str(row["found_on"]), str(row["controller"]))
        found.setdefault(who, []).append(float(row["deviation_m"]))
    return tuple(
        f"{method}, found against {found_on}: {fmean(deviations):.2f} m deviation of {controller}"
        for (method, found_on, controller), deviations in found.items()
    )


def _failed(row: Record) -> bool:
    # A table has no text there, or what stands for none.
    return isinstance(row["error"], str) and bool(row["error"])

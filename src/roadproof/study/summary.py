"""What came of a study, in a few lines."""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from pandas import DataFrame


def summary(rows: DataFrame) -> tuple[str, ...]:
    """A line for each method: means over its jobs, driven alone in the weather the patterns were found in."""
    good = rows[rows["error"].isna()]
    if good.empty:
        return ()
    weather = good["weather"].iloc[0]
    alone = good[(good["weather"] == weather) & ~good["traffic"].astype(bool)]
    means = alone.groupby("method", sort=False)[["deviation_m", "search_calls", "search_seconds"]].mean()
    return tuple(
        f"{method}: {deviation:.2f} m deviation, alone in {weather}; found with {calls:.0f} simulator calls in "
        f"{seconds:.0f} s"
        for method, deviation, calls, seconds in means.itertuples()
    )


def failures(rows: DataFrame) -> tuple[str, ...]:
    """A line for each job that failed."""
    return tuple(
        f"{job.scenario}, K = {job.figures}, {job.method}, seed {job.seed}: {job.error}"
        for job in rows[rows["error"].notna()].itertuples()
    )


def matrix(rows: DataFrame) -> tuple[str, ...]:
    """A line for each method and controller of a transfer: the mean deviation."""
    means = rows.groupby(["method", "found_on", "controller"], sort=False)["deviation_m"].mean()
    return tuple(
        f"{method}, found against {found_on}: {deviation:.2f} m deviation of {controller}"
        for (method, found_on, controller), deviation in means.items()
    )

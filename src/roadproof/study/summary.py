"""What came of a study, in a few lines for the screen."""

from __future__ import annotations

from roadproof.study.rows import Frame, JobId, made_by_all

_OTHERS = [name for name in JobId._fields if name != "method"]


def summary(rows: Frame, home: str) -> tuple[str, ...]:
    """A line for each method: means over its jobs, driven alone in the weather the patterns were found in.

    Args:
        rows: the rows of the study (`study.rows`).
        home: the weather in which patterns were found.
    """
    good = rows[rows["error"].isna()]
    if good.empty:
        return ()
    alone = good[~good["traffic"].astype(bool) & (good["weather"] == home)]
    numbers = ["deviation_m", "search_calls", "search_seconds"]
    of_jobs = alone.astype(dict.fromkeys(numbers, float)).groupby(["method", *_OTHERS], sort=False)[numbers].mean()
    means = of_jobs.groupby(level="method", sort=False).mean()
    return tuple(
        f"{method}: {deviation_m:.2f} m mean deviation, alone in {home}; found with {calls:.0f} simulator calls in "
        f"{seconds:.0f} s"
        for method, deviation_m, calls, seconds in means.itertuples()
    )


def failures(rows: Frame) -> tuple[str, ...]:
    """A line for each job that failed."""
    bad = rows[rows["error"].notna()]
    return tuple(f"{JobId(*job)}: {why}" for *job, why in bad[[*JobId._fields, "error"]].itertuples(index=False))


def transfer_summary(rows: Frame) -> tuple[str, ...]:
    """A line for each method and controller of a transfer: the mean over patterns, of the drives that all made."""
    whose = ["method", "found_on", "controller"]
    patterns = made_by_all(rows).groupby([*_OTHERS, *whose], sort=False)["deviation_m"].mean()
    means = patterns.groupby(level=whose, sort=False).mean()
    return tuple(
        f"{method}, found against {found_on}: {deviation_m:.2f} m mean deviation of {controller}"
        for (method, found_on, controller), deviation_m in means.items()
    )

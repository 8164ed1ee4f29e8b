"""What stands side by side in tables and charts: a metric under one condition."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from roadproof.report.study.results import Method, Results
from roadproof.report.study.statistics import Case


@dataclass(frozen=True, slots=True)
class Metric:
    """A number of `Instance` and how tables call it."""

    field: str
    title: str
    unit: str


DEVIATION = Metric("deviation_m", "Deviation", "m")
LEFT_LANE = Metric("left_lane", "Leave the lane", "share of drives")
PENALTY = Metric("points", "Infraction penalty", "points")


@dataclass(frozen=True, slots=True)
class Block:
    """Columns of a table that belong together: one metric under one condition.

    Args:
        heading: over them.
        metric: what they hold.
        weather: of the drives.
        traffic: whether there were others.
        kind: of scenarios; None takes all.
    """

    heading: str
    metric: Metric
    weather: str
    traffic: bool
    kind: str | None = None

    def values(self, results: Results, method: str, figures: str) -> dict[Case, float]:
        """What one method reached."""
        return results.values(
            self.metric.field, method, figures, weather=self.weather, traffic=self.traffic, kind=self.kind
        )


def overall(results: Results) -> tuple[Block, Block]:
    """Deviation alone and penalty in traffic, as the paper has them, in the weather in which patterns were found.

    Where the study drove only alone, or only in traffic, both are of that.
    """
    busy, alone = results.has(traffic=True), results.has(traffic=False)
    return (
        Block(DEVIATION.title, DEVIATION, results.home, not alone),
        Block(PENALTY.title, PENALTY, results.home, busy),
    )


def reference(methods: Sequence[Method]) -> Method:
    """The method that others are compared with: the plan's, else GradOpt in groups of three, any GradOpt, the first."""
    named = [method for method in methods if method.reference]
    gradopt = [method for method in methods if method.search == "gradopt"]
    chosen = [method for method in gradopt if (method.scheme, method.trajectories) == ("group", 3)]
    return [*named, *chosen, *gradopt, *methods][0]


def compared(methods: Sequence[Method]) -> list[str]:
    """Names of GradOpt and what it is compared with; in pictures, variants of it would only hide one another."""
    return [reference(methods).name, *(method.name for method in rivals(methods))]


def rivals(methods: Sequence[Method]) -> tuple[Method, ...]:
    """The methods that `reference` is compared with; other variants of GradOpt have the ablation."""
    ours = reference(methods)
    return tuple(method for method in methods if method.search != "gradopt" and method != ours)

"""A study of four scenarios whose means can be done in the head."""

from pandas import DataFrame

from roadproof.study.kept_jobs import StatedMethod
from roadproof.study.results import results_of

GRADOPT = StatedMethod(name="GradOpt", search="gradopt", trajectories=3, scheme="group")
BO = StatedMethod(name="BO", search="published-bo")


def row(scenario="left-01", figures="1", method="GradOpt", seed=0, **changed):
    """One drive."""
    return {
        "scenario": scenario,
        "kind": scenario.split("-")[0],
        "figures": figures,
        "method": method,
        "seed": seed,
        "weather": "clear-noon",
        "traffic": False,
        "traffic_seed": 0,
        "deviation_m": 1.0,
        "left_lane": True,
        "points": 2.0,
        "clean_points": 0.5,
        "search_calls": 61 if method == "GradOpt" else 1000,
        "search_seconds": 30.0,
        "error": None,
    } | changed


def bad(why="no luck", **job):
    """A job that failed, as the Parquet file gives it back."""
    nothing = dict.fromkeys(("weather", "traffic", "deviation_m", "points", "clean_points", "search_calls"), None)
    return row(**job) | nothing | {"search_seconds": float("nan"), "error": why}


DEVIATIONS = {
    ("straight-01", "GradOpt"): 1.0, ("straight-01", "BO"): 0.5,
    ("left-01", "GradOpt"): 2.0, ("left-01", "BO"): 2.0,
    ("left-02", "GradOpt"): 1.5, ("left-02", "BO"): 2.5,
    ("right-01", "GradOpt"): 3.0, ("right-01", "BO"): 1.0,
}  # fmt: skip


def hand_made_records():
    """Four scenarios, K = 1 and 5, alone and twice in traffic, two weathers; at K = 5 one metre more."""
    return [
        row(
            scenario,
            figures,
            method,
            weather=weather,
            traffic=run > 0,
            traffic_seed=run,
            deviation_m=deviation + (1.0 if figures == "5" else 0.0) - (0.25 if weather == "rainy-noon" else 0.0),
            points=deviation * 2 + run,
        )
        for figures in ("5", "1")
        for (scenario, method), deviation in DEVIATIONS.items()
        for weather in ("clear-noon", "rainy-noon")
        for run in range(3)
    ]


def results(rows, methods=(), named=None):
    """The numbers of a list of rows."""
    return results_of(DataFrame(rows), methods, named)

"""A made-up study folder: seeded numbers of a realistic size, in the files that jobs write."""

import json

import numpy as np
import torch
from PIL import Image

from roadproof.coverage import Shape
from roadproof.datatypes import Weather
from roadproof.driving.starts import StartPlan
from roadproof.patterns import Pattern, save_pattern
from roadproof.roads.maps import load_map, scenario_route
from roadproof.scenarios import builtin_scenarios
from roadproof.study.folder import write_result, write_table
from roadproof.study.methods import BlackBoxPlan, GradOptPlan
from roadproof.study.plan import Study, TrafficPlan
from roadproof.study.rows import JobResult, failed, job_columns

METHODS = (
    GradOptPlan(name="GradOpt", objective="steering", trajectories=3),
    GradOptPlan(name="GradOpt T=1", objective="steering", trajectories=1),
    GradOptPlan(name="All", objective="steering", trajectories=3, scheme="group-all"),
    BlackBoxPlan(name="BO", search="published-bo", calls=1000),
    BlackBoxPlan(name="TPE", search="tpe", calls=200),
)
WEATHERS = (Weather.CLEAR_NOON, Weather.CLOUDY_NOON, Weather.RAINY_NOON)
CALLS = {"gradopt": 61, "published-bo": 1000, "tpe": 200, "random": 20}


def made_up_study(**changed):
    """A plan like the paper's, smaller."""
    scenarios = builtin_scenarios()
    picked = [s for kind in ("straight", "left", "right") for s in [s for s in scenarios if s.kind == kind][:3]]
    values = {
        "controller": "cil",
        "scenarios": tuple(picked),
        "figures": ("1-b", 1, 3, 5),
        "methods": METHODS,
        "weathers": WEATHERS,
        "starts": StartPlan(count=1),
        "traffic": TrafficPlan(runs=3),
    }
    return Study(**values | changed)


def strength(job, generator):
    """How far aside a pattern steers, in metres; more with K, less for black-box searches."""
    k = 1 if job.figures == "1-b" else int(job.figures)
    ours = job.method.search == "gradopt"
    typical = (0.7 + 0.12 * k if ours else 0.6 + 0.03 * k) * {"straight": 0.6, "left": 1.2, "right": 1.1}[
        job.scenario.kind
    ]
    return float(typical * generator.lognormal(0.0, 0.35))


def rows_of(job, pushed_m, generator):
    """One drive alone and some in traffic for every weather."""
    rows = []
    runs = [(False, 0)] + [(True, run) for run in range(job.traffic.runs if job.traffic else 0)]
    for number, weather in enumerate(job.weathers):
        for traffic, seed in runs:
            deviation = pushed_m * (1.0 - 0.15 * number) * float(generator.uniform(0.9, 1.1))
            hit = deviation > 0.8
            rows.append(
                {
                    **job_columns(job),
                    "controller": job.controller,
                    "weather": str(weather),
                    "traffic": traffic,
                    "traffic_seed": seed,
                    "deviation_m": deviation,
                    "lateral_m": 2 * deviation,
                    "points": float(generator.choice([2, 6, 9]) if hit else generator.choice([0, 0, 2])),
                    "clean_points": 0.0,
                    "leaderboard": 0.65 if hit else 1.0,
                    "clean_leaderboard": 1.0,
                    "first_event_s": 4.2 if hit else None,
                    "left_lane": hit,
                    "ending": "collision" if hit else "goal reached",
                    "search_calls": CALLS[job.method.search],
                    "search_seconds": CALLS[job.method.search] * float(generator.uniform(0.8, 1.3)),
                    "evaluation_calls": len(job.weathers) * len(runs),
                    "seconds": 100.0,
                    "error": None,
                }
            )
    return rows


def files_of(job, pushed_m, generator):
    """Pattern, paths and the course of the search."""
    k = 1 if job.figures == "1-b" else int(job.figures)
    boxes = np.column_stack([
        generator.uniform(90, 310, k), np.full(k, 200.0), generator.uniform(20, 90, k), generator.uniform(250, 390, k),
        generator.uniform(0, 180, k),
    ])  # fmt: skip
    colours = np.zeros((k, 3)) if job.figures == "1-b" else generator.uniform(0, 1, (k, 3))
    pattern = Pattern((Shape.RECTANGLE,) * k, torch.tensor(boxes).float(), torch.tensor(colours).float())
    route = scenario_route(job.scenario, load_map(job.scenario.map_name))
    middle_m = route.locate(job.scenario.canvas.x_m, job.scenario.canvas.y_m).arclength_m
    at = np.arange(0.0, route.length_m - 1.0, 0.4)
    x, y = np.array([route.at(s)[:2] for s in at]).T
    heading = np.arctan2(np.gradient(y), np.gradient(x))
    aside = 2.4 * pushed_m * np.exp(-(((at - middle_m - 8) / 11) ** 2))
    calls = np.arange(1, CALLS[job.method.search] + 1)
    best = np.maximum.accumulate(generator.gumbel(4 * pushed_m, 1.5, len(calls)) + 2 * np.log(calls) / 3)
    seconds = calls * (1.0 + 0.002 * calls)
    history = {"format": "roadproof-study-history", "version": 1, "best": best.tolist()}
    history |= {"calls": calls.tolist(), "seconds": seconds.tolist()}
    if job.method.search == "gradopt":
        driven = {"calls": [int(calls[-1])], "seconds": [float(seconds[-1])], "best": [pushed_m]}
        history |= {"kind": "surrogate", "measure": "steering shift", "driven": driven}
    else:
        reached = pushed_m * best / best[-1]
        history |= {"kind": "closed loop", "measure": "steering", "deviation_m": reached.tolist()}
    paths = {
        "clean_xy": np.column_stack([x, y]),
        "painted_xy": np.column_stack([x - aside * np.sin(heading), y + aside * np.cos(heading)]),
    }
    return pattern, paths, history


def write_made_up_study(folder, study, *, failing=(), seed=0):
    """Every job of a study as finished, but for those that `failing` names by scenario, K and method.

    Returns:
        The frame of its rows.
    """
    for number, job in enumerate(study.jobs):
        generator = np.random.default_rng((seed, number))
        if (job.scenario.name, job.figures, job.method.name) in failing:
            write_result(job, failed(job, "its process died"), folder)
            continue
        pushed_m = strength(job, generator)
        rows = rows_of(job, pushed_m, generator)
        pattern, paths, history = files_of(job, pushed_m, generator)
        write_result(job, JobResult(tuple(rows), {"history.json": json.dumps(history).encode()}), folder)
        place = folder / "jobs" / job.key
        save_pattern(pattern, place / "pattern.json")
        np.savez(place / "paths.npz", **paths)
        for shade, weather in enumerate(job.weathers, 1):
            Image.new("RGB", (1440, 180), (60 * shade,) * 3).save(place / f"passage-{weather}.jpg")
    return write_table(study.jobs, folder)

"""`roadproof record`: scenarios in, recorded drives past the bare canvas out."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from roadproof.cli import options
from roadproof.cli.options import argument, number
from roadproof.cli.output import answer, say, stored
from roadproof.cli.verbs import begin, keep_command

if TYPE_CHECKING:
    from roadproof.drives import Drives


def record(
    names: Annotated[list[str], argument("Scenarios; `roadproof scenarios` lists them.")],
    scenarios: options.ScenarioFile = None,
    driver: options.DriverSpec = "expert",
    weather: options.WeatherName = "clear-noon",
    budget: options.BudgetName = "quick",
    trajectories: Annotated[
        int | None, number("T, how many drives, an odd number.", 1, 7, default="the budget's")
    ] = None,
    scheme: Annotated[
        str, typer.Option(help="group: pairs to the right and left; random: each to both sides.")
    ] = "group",
    swerve_m: Annotated[
        list[float] | None,
        number("How far drives swerve; several are taken in turn.", 0.1, 5.0, default="the budget's"),
    ] = None,
    noise_deg: Annotated[
        tuple[int, int] | None,
        number("Perturb by noise on the steering instead, least and most, as published.", 0, 57, default=False),
    ] = None,
    horizon_m: Annotated[float, number("Keep frames from so far before the canvas.", 1.0, 1000.0)] = 25.0,
    frames: Annotated[int | None, number("Keep at most so many a drive.", 1, 10_000, default="the budget's")] = None,
    seed: options.Seed = 0,
    simulator: options.SimulatorSpec = "town",
    device: options.Device = "cpu",
    out: options.Out = Path("out/runs"),
) -> None:
    """Record drives past the canvas, clean and perturbed: a run for each scenario, in a folder of its name."""
    from dataclasses import replace

    from roadproof.cli.progress import progress
    from roadproof.drives import Scheme, SteeringNoise, Swerve, Trajectories
    from roadproof.drives import record as run
    from roadproof.errors import RecordingError, ScenarioError
    from roadproof.io.files import inside
    from roadproof.pipeline.budget import BUDGETS
    from roadproof.pipeline.workload import RECORDED_DRIVE
    from roadproof.simulators.loading import open_simulator

    chosen = [options.scenario_of(name, scenarios) for name in dict.fromkeys(names)]
    sky = options.weather_of(weather)
    if noise_deg is not None and swerve_m:
        raise RecordingError("both --noise-deg and --swerve-m are given; choose one way to perturb drives")
    usual = BUDGETS[options.choice(budget, "budget", tuple(BUDGETS))]
    changed = {
        "swerve-m": bool(swerve_m),
        "frames": frames not in (None, usual.window.frames),
        "horizon-m": horizon_m != usual.window.horizon_m,
    }
    if budget == "published" and (other := next((name for name, given in changed.items() if given), None)):
        raise RecordingError(
            f"--{other} is given with --budget published, which records as the paper did; leave one of them out"
        )
    perturbation = usual.trajectories.perturbation
    if swerve_m:
        perturbation = Swerve(tuple(swerve_m), perturbation.weaves_m if isinstance(perturbation, Swerve) else ())
    if noise_deg is not None:
        perturbation = SteeringNoise(*noise_deg)
    wanted = Trajectories(
        count=usual.trajectories.count if trajectories is None else trajectories,
        scheme=Scheme(options.choice(scheme, "scheme", tuple(Scheme))),
        perturbation=perturbation,
    )
    kept = usual.window.frames if frames is None else frames
    window = replace(usual.window, horizon_m=horizon_m, frames=kept)
    places = {scenario.name: inside(out, scenario.name, "scenario", ScenarioError) for scenario in chosen}
    who = options.driver_of(driver, device)
    begin(RECORDED_DRIVE.times(wanted.count * len(chosen)), *places.values())

    made: list[dict[str, object]] = []
    with open_simulator(simulator) as world:
        for scenario in chosen:
            with progress(f"Recording {scenario.name}", wanted.count, "drives") as show:
                drives = run(
                    world,
                    who,
                    scenario,
                    weather=sky,
                    trajectories=wanted,
                    window=window,
                    seed=seed,
                    driver_name=driver,
                    folder=places[scenario.name] / "record",
                    on_drive=lambda done, show=show: show(done, 0.0),
                )
            keep_command(places[scenario.name] / "record")
            _summarise(drives, places[scenario.name])
            made.append(_answer(drives, places[scenario.name]))
    answer({"runs": made})


def _summarise(drives: Drives, run: Path) -> None:
    say(f"{drives.settings.scenario.name}, {drives.settings.weather}: {drives.calls} drives, kept in {run / 'record'}")
    for drive in drives.drives:
        steps = f"steps {drive.frame_number[0]} to {drive.frame_number[-1]}"
        aside = f"up to {drive.offset_m:+.2f} m to the right" if drive.offset_m else "clean"
        say(f"  {drive.name:8} {len(drive.frames)} frames, {steps}, {aside}{drive.note and '; ' + drive.note}")


def _answer(drives: Drives, run: Path) -> dict[str, object]:
    """What record.json holds, and what came of the drives."""
    told = [
        {
            "name": drive.name,
            "frames": len(drive.frames),
            "first_step": drive.frame_number[0],
            "last_step": drive.frame_number[-1],
            "offset_right_m": drive.offset_m,
            "simulator_calls": drive.calls,
            "note": drive.note,
        }
        for drive in drives.drives
    ]
    return {"folder": str(run), **stored(run / "record" / "record.json"), "drives": told}

"""`roadproof select`: what an attack found, driven over; the strongest of it is kept."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from roadproof.cli import options
from roadproof.cli.options import argument, number
from roadproof.cli.output import answer, say, stored
from roadproof.cli.verbs import keep_command

if TYPE_CHECKING:
    from roadproof.attacks import AttackResult, Candidate
    from roadproof.patterns import Pattern
    from roadproof.pipeline.selection import Selection


def select(
    run: Annotated[Path, argument("A run that was recorded, calibrated and attacked.")],
    controller: options.ControllerSpec,
    best: Annotated[int, number("How many of the attack's candidates are driven, once each.", 1, 1000)] = 6,
    simulator: options.WorldSpec = "town",
    device: options.Device = "cpu",
) -> None:
    """Drive over the best candidates of an attack, which composites rank only coarsely, and keep the strongest.

    In recordings the drives are predicted.
    """
    from roadproof.attacks import AttackResult
    from roadproof.cli.progress import progress
    from roadproof.controllers import load_controller
    from roadproof.drives.folder import read_settings
    from roadproof.errors import RoadproofError
    from roadproof.io.locks import hold
    from roadproof.patterns import save_pattern
    from roadproof.pipeline.selection import UNITS, chosen_by, select_by_driving
    from roadproof.pipeline.worlds import open_world, recorded_in

    recorded = read_settings(run / "record")
    place = run / "attack"
    if not (place / "result.json").exists():
        raise RoadproofError(
            f"{place} holds no attack; make it with: roadproof attack {run / 'recordings'} --controller {controller} "
            f"--out {place}"
        )
    found = AttackResult.load(place)
    hold(run)
    inside = recorded_in(simulator)
    who = load_controller(controller, device=device)
    total, unit = 1 + min(best, len(found.candidates)), UNITS[chosen_by(found.candidates)]
    with (
        open_world(simulator, device) as world,
        progress(f"Driving {recorded.scenario.name}", total, f"drives, {{:.2f}} {unit}") as show,
    ):
        selection = select_by_driving(
            world,
            who,
            recorded.scenario,
            found.candidates,
            best=best,
            weather=recorded.weather if inside is None else inside.weather,
            folder=run / "selection",
            on_drive=show,
        )
    keep_command(run / "selection")
    if not _is_in(run / "pattern.json", selection.pattern):
        # It is of another pattern; the stress test makes it again.
        (run / "prediction.npz").unlink(missing_ok=True)
    save_pattern(selection.pattern, run / "pattern.json")
    _summarise(selection, found, run)
    answer(stored(run / "selection" / "selection.json"))


def _is_in(path: Path, pattern: Pattern) -> bool:
    """Whether a file holds this pattern."""
    from roadproof.errors import PatternError
    from roadproof.io.identity import stated
    from roadproof.io.known import known_by
    from roadproof.patterns import load_pattern

    try:
        return stated(known_by(load_pattern(path))) == stated(known_by(pattern))
    except PatternError:
        return False


def _summarise(selection: Selection, found: AttackResult, run: Path) -> None:
    from roadproof.driving.speed import speed_in_words
    from roadproof.pipeline.selection import SPEED

    driven = "predicted drive" if selection.predicted else "driven"
    for k, each in enumerate(selection.driven):
        points = "points not known" if each.trial.points is None else f"{each.trial.points:g} points"
        change_mps = each.trial.speed_change_mps
        faster = "" if selection.chosen_by != SPEED or change_mps is None else f"{speed_in_words(change_mps)}, "
        say(
            f"  {each.rank:2} {each.group:12} {_expected(found.candidates[each.rank - 1])}{driven}: {faster}"
            f"deviation {each.trial.deviation_m:.2f} m, {abs(each.trial.lateral_m):.2f} m aside, {points}"
            f"{'  <- kept' if k == selection.chosen else ''}"
        )
    pattern = run / "pattern.json"
    drives = "nothing was driven for real" if selection.predicted else f"{selection.simulator_calls} drives"
    say(f"{drives}; the strongest is {pattern}, by {selection.chosen_by}; next: roadproof evaluate {pattern} ...")


def _expected(candidate: Candidate) -> str:
    """What the search says of a candidate: metres or m/s where it drove in recordings, else how steering shifts."""
    if candidate.predicted is not None:
        return f"predicted {candidate.predicted}, "
    if candidate.surrogate_shift is not None:
        return f"steering shift {candidate.surrogate_shift:+.3f} a frame, "
    return ""

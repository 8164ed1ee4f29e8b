"""`roadproof calibrate`: recorded drives in, recordings ready for attacks out."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from roadproof.cli.options import SimulatorSpec, argument, choice
from roadproof.cli.output import answer, say, stored
from roadproof.cli.verbs import keep_command

if TYPE_CHECKING:
    from roadproof.calibration import CalibrationReport


def calibrate(
    folder: Annotated[Path, argument("A run that `roadproof record` made, or a folder of such runs.")],
    method: Annotated[
        str,
        typer.Option(
            help="two-paint: canvas white, then black with grey squares, homographies from their edges; pose: the same "
            "colours, homographies from the poses; published: coloured points and 22 colours."
        ),
    ] = "two-paint",
    simulator: SimulatorSpec = "town",
) -> None:
    """Find out where the canvas is in recorded drives and how paint looks there. A second call goes on where the first
    ended."""  # noqa: D205, D209
    from roadproof.calibration import METHODS, Calibrated, replays_needed
    from roadproof.calibration import calibrate as run
    from roadproof.cli.progress import progress
    from roadproof.drives import Drives
    from roadproof.drives.folder import require_same_map
    from roadproof.errors import RecordingError
    from roadproof.io.locks import hold
    from roadproof.simulators.loading import open_simulator

    how = choice(method, "method", METHODS)
    runs = [folder] if (folder / "record").is_dir() else sorted(path.parent for path in folder.glob("*/record"))
    if not runs:
        raise RecordingError(f"{folder} holds no run with a folder named record; make one with `roadproof record`")
    recorded = {path: Drives.load(path / "record") for path in runs}
    for path, drives in recorded.items():
        require_same_map(drives.settings, path / "record")
    for place in dict.fromkeys((folder, *runs)):
        hold(place)

    for path, drives in recorded.items():
        done = Calibrated.kept(path, drives, how)
        if done is not None:
            _summarise(done.report, path)
            continue
        with (
            open_simulator(simulator) as world,
            progress(f"Calibrating {path.name}", replays_needed(len(drives.drives), how), "replays") as show,
        ):
            result = run(
                world, drives, how, folder=path / "calibration", on_call=lambda done, show=show: show(done, 0.0)
            )
        result.save(path)
        keep_command(path / "calibration")
        _summarise(result.report, path)
    answer({"runs": [{"folder": str(run), **stored(run / "calibration" / "report.json")} for run in runs]})


def _summarise(report: CalibrationReport, run: Path) -> None:
    say(f"{run.name}, {report.method}: {report.calls} simulator calls, recording included, {report.seconds:.0f} s")
    if report.colour_residual is not None:
        say(f"  colours fit within {report.colour_residual:.1f} of 255 levels on average")
    for drive in report.drives:
        parts = [f"{drive.frames} frames"]
        if drive.residual_px is not None:
            parts.append(f"fits what was seen within {drive.residual_px.mean:.2f} px")
        if drive.stated_px is not None:
            parts.append(f"{drive.stated_px.mean:.2f} px from what the simulator states")
        say(f"  {drive.name:8} {', '.join(parts)}")
        for number, reason in drive.dropped:
            say(f"    frame {number} dropped: {reason}")
    say(f"Recordings in {run / 'recordings'}; next: roadproof attack {run / 'recordings'} --controller ...")

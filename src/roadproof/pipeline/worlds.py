"""A world to drive in by its name: a simulator, or recordings in which a scenario begins where they do."""

from __future__ import annotations

from contextlib import AbstractContextManager
from dataclasses import dataclass
from pathlib import Path

from roadproof.datatypes import Weather
from roadproof.drives.folder import read_settings
from roadproof.errors import RecordingError, RoadproofError
from roadproof.recorded.simulator import RecordedSimulator, light_of
from roadproof.recordings import load_recordings, stated_weather
from roadproof.scenarios import Scenario
from roadproof.simulators.loading import RECORDED, MappedSimulator, open_simulator


@dataclass(frozen=True, slots=True)
class Recorded:
    """Recordings that are driven in.

    Args:
        folder: the folder of the set.
        scenario: the scenario that was recorded, where the set lies in a run that says so; else None.
        weather: the weather it was recorded in; clear noon where nothing says it.
    """

    folder: Path
    scenario: Scenario | None
    weather: Weather


def recorded_in(spec: str) -> Recorded | None:
    """The recordings that "recorded:FOLDER" means, a set or a run with one in it; None where a simulator is meant.

    Raises:
        RoadproofError: no folder is named, or the run's recording is damaged.
    """
    if not spec.startswith(RECORDED):
        return None
    if spec == RECORDED:
        raise RoadproofError(
            f"--simulator is {spec!r}, expected the folder of recordings, or of a run, after the colon"
        )
    folder = Path(spec.removeprefix(RECORDED)).resolve()
    run = folder if (folder / "recordings").is_dir() else folder.parent if folder.name == "recordings" else None
    there = folder if run is None else run / "recordings"
    if not (there / "recordings.json").is_file():
        raise RecordingError(f"{there} has no recordings.json; expected recordings, or a run that has some")
    if run is None or not (run / "record" / "record.json").is_file():
        return Recorded(there, None, light_of(stated_weather(there)))
    settings = read_settings(run / "record")
    return Recorded(there, settings.scenario, settings.weather)


def open_world(spec: str, device: str = "cpu") -> AbstractContextManager[MappedSimulator | RecordedSimulator]:
    """Open what a spec names for a with-block; leaving frees everything it holds.

    Args:
        spec: "town", "carla://HOST:PORT" or "recorded:FOLDER".
        device: the torch device on which a recorded world makes its pictures.

    Raises:
        RoadproofError: no world has this name, or what it needs is not there.
    """
    inside = recorded_in(spec)
    if inside is None:
        return open_simulator(spec)
    return RecordedSimulator(load_recordings(inside.folder), weather=inside.weather, device=device)

"""What `--simulator` of the verbs that drive may name: a simulator, or recordings to drive in."""

from __future__ import annotations

from collections.abc import Generator
from contextlib import AbstractContextManager, contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

from roadproof.cli.options import RECORDED, scenario_of
from roadproof.errors import RecordingError, RoadproofError

if TYPE_CHECKING:
    from roadproof.datatypes import Weather
    from roadproof.recorded import RecordedSimulator
    from roadproof.scenarios import Scenario
    from roadproof.simulators.loading import MappedSimulator


@dataclass(frozen=True, slots=True)
class Recorded:
    """Recordings that are driven in.

    Args:
        folder: the folder of the set.
        scenario: the scenario that was recorded, where the set lies in a run that says so; else None.
        weather: the weather it was recorded in; a set alone does not say it, and its light is called clear-noon.
    """

    folder: Path
    scenario: Scenario | None
    weather: Weather


@dataclass(frozen=True, slots=True)
class World:
    """Where a verb drives.

    Args:
        spec: "town", "carla://HOST:PORT" or "recorded:FOLDER".
        device: the torch device on which a recorded world makes its pictures.
        recorded: the recordings that are driven in; None in a simulator.
        scenario: the scenario that is driven; None for the recorded stretch itself.
    """

    spec: str
    device: str
    recorded: Recorded | None
    scenario: Scenario | None

    @contextmanager
    def open(self) -> Generator[tuple[MappedSimulator | RecordedSimulator, Scenario]]:
        """Open the world for a with-block, which gets the simulator and the scenario; a recorded one begins where the
        recordings do.

        Raises:
            RoadproofError: the simulator is not there, or the recordings say too little to drive in.
        """  # noqa: D205
        from roadproof.recorded import RecordedSimulator

        with open_world(self.spec, self.device) as world:
            if isinstance(world, RecordedSimulator):
                there = world.scenario
                yield world, there if self.scenario is None else replace(self.scenario, start=there.start)
            else:
                assert self.scenario is not None
                yield world, self.scenario


def world_asked(spec: str, device: str, driver: str, name: str | None, file: Path | None) -> World:
    """The world of a verb's options.

    Args:
        spec: what `--simulator` names.
        device: what `--device` names.
        driver: what `--controller` names.
        name: the scenario that was named, if any; by default that of the recordings, or left-03.
        file: a file with scenarios of the user's own; the built-in ones by default.

    Raises:
        RoadproofError: there are no such recordings, or the expert is to drive in them.
        ScenarioError: there is no scenario of this name, or the file is damaged.
    """
    recorded = recorded_in(spec)
    if recorded is not None and name is None and file is None:
        scenario = recorded.scenario
    else:
        scenario = scenario_of(name or "left-03", file)
    if recorded is not None and driver == "expert":
        raise RoadproofError("the expert needs a map, which recordings do not have; give a --controller")
    return World(spec, device, recorded, scenario)


def recorded_in(spec: str) -> Recorded | None:
    """The recordings that "recorded:FOLDER" means, a set or a run with one in it; None where a simulator is meant.

    Raises:
        RoadproofError: no folder is named, or the run's recording is damaged.
    """
    if not spec.startswith(RECORDED):
        return None
    from roadproof.datatypes import Weather
    from roadproof.drives.folder import read_settings

    if spec == RECORDED:
        raise RoadproofError(
            f"--simulator is {spec!r}, expected the folder of recordings, or of a run, after the colon"
        )
    folder = Path(spec.removeprefix(RECORDED))
    run = folder if (folder / "recordings").is_dir() else folder.parent if folder.name == "recordings" else None
    there = folder if run is None else run / "recordings"
    if not (there / "recordings.json").is_file():
        raise RecordingError(f"{there} has no recordings.json; expected recordings, or a run that has some")
    if run is None or not (run / "record" / "record.json").is_file():
        return Recorded(there, None, Weather.CLEAR_NOON)
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
    from roadproof.recorded import RecordedSimulator
    from roadproof.recordings import load_recordings
    from roadproof.simulators.loading import open_simulator

    inside = recorded_in(spec)
    if inside is None:
        return open_simulator(spec)
    return RecordedSimulator(load_recordings(inside.folder), weather=inside.weather, device=device)

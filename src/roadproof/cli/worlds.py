"""What `--simulator` of the verbs that drive may name: a simulator, or recordings to drive in."""

from __future__ import annotations

from collections.abc import Generator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

from roadproof.errors import RoadproofError

if TYPE_CHECKING:
    from roadproof.datatypes import Weather
    from roadproof.recorded.simulator import RecordedSimulator
    from roadproof.scenarios import Scenario
    from roadproof.simulators.loading import MappedSimulator
    from roadproof.simulators.protocol import Simulator

RECORDED = "recorded:"


@dataclass(frozen=True, slots=True)
class Recorded:
    """Recordings that are driven in.

    Args:
        folder: of the set.
        scenario: that was recorded, where the set lies in a run that says so.
        weather: at which; a set alone does not say it, and its light is called clear-noon.
    """

    folder: Path
    scenario: Scenario | None
    weather: Weather

    @contextmanager
    def open(self, device: str = "cpu") -> Generator[RecordedSimulator]:
        """The recorded world, for a with-block.

        Raises:
            RecordingError: the set is missing, damaged, or says too little to drive in.
        """
        from roadproof.recorded.simulator import RecordedSimulator
        from roadproof.recordings import load_recordings

        with RecordedSimulator(load_recordings(self.folder), weather=self.weather, device=device) as world:
            yield world


def recorded_in(spec: str) -> Recorded | None:
    """The recordings that "recorded:FOLDER" means, a set or a run with one in it; None where a simulator is meant.

    Raises:
        RoadproofError: no folder is named, or the run's recording is damaged.
    """
    if not spec.startswith(RECORDED):
        return None
    from roadproof.datatypes import Weather
    from roadproof.drives import load_drives

    if spec == RECORDED:
        raise RoadproofError(
            f"--simulator is {spec!r}, expected the folder of recordings, or of a run, after the colon"
        )
    folder = Path(spec.removeprefix(RECORDED))
    run = folder if (folder / "recordings").is_dir() else folder.parent if folder.name == "recordings" else None
    if run is None or not (run / "record" / "record.json").is_file():
        return Recorded(folder if run is None else run / "recordings", None, Weather.CLEAR_NOON)
    settings = load_drives(run / "record").settings
    return Recorded(run / "recordings", settings.scenario, settings.weather)


@contextmanager
def open_world(spec: str, device: str = "cpu") -> Generator[MappedSimulator | RecordedSimulator]:
    """Open what a spec names for a with-block; leaving frees everything it holds.

    Args:
        spec: "town", "carla://HOST:PORT" or "recorded:FOLDER".
        device: where a recorded world makes its pictures.

    Raises:
        RoadproofError: there is none of this name, or what it needs is not there.
    """
    recorded = recorded_in(spec)
    if recorded is not None:
        with recorded.open(device) as world:
            yield world
        return
    from roadproof.simulators.loading import open_simulator

    with open_simulator(spec) as world:
        yield world


def scenario_asked(recorded: Recorded | None, name: str | None, file: Path | None) -> Scenario | None:
    """The scenario to drive; None where it is the recorded stretch itself, which nobody named.

    Args:
        recorded: what is driven in, where that is recordings.
        name: that was given.
        file: with scenarios of the user's own; the built-in ones by default.

    Raises:
        ScenarioError: there is none of this name, or the file is damaged.
    """
    from roadproof.scenarios import BUILTIN_FILE, find_scenario, load_scenarios

    if recorded is not None and name is None and file is None:
        return recorded.scenario
    return find_scenario(name or "left-03", load_scenarios(file or BUILTIN_FILE))


def stretch_of(world: Simulator, scenario: Scenario | None) -> Scenario:
    """A scenario, or where none was asked for, that of the recordings; in these it begins where they do."""
    from roadproof.recorded.simulator import RecordedSimulator

    if isinstance(world, RecordedSimulator):
        return world.scenario if scenario is None else replace(scenario, start=world.scenario.start)
    assert scenario is not None
    return scenario


def check_driver(controller: str) -> None:
    """Refuse to drive in recordings with whom they give too little.

    Raises:
        RoadproofError: it is the expert.
    """
    if controller == "expert":
        raise RoadproofError("the expert needs a map, which recordings do not have; give a --controller")

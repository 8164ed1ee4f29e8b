"""What `--simulator` of the verbs that drive may name: a simulator, or recordings to drive in."""

from __future__ import annotations

from collections.abc import Generator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from roadproof.cli.options import scenario_of
from roadproof.errors import RoadproofError

if TYPE_CHECKING:
    from roadproof.pipeline.worlds import Recorded
    from roadproof.recorded import RecordedSimulator
    from roadproof.scenarios import Scenario
    from roadproof.simulators.loading import MappedSimulator


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
        from roadproof.pipeline.worlds import open_world
        from roadproof.recorded import RecordedSimulator
        from roadproof.simulators.protocol import begun_in

        with open_world(self.spec, self.device) as world:
            if self.scenario is None:
                assert isinstance(world, RecordedSimulator)
                yield world, world.scenario
            else:
                yield world, begun_in(world, self.scenario)


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
    from roadproof.pipeline.worlds import recorded_in

    recorded = recorded_in(spec)
    if recorded is not None and name is None and file is None:
        scenario = recorded.scenario
    else:
        scenario = scenario_of(name or "left-03", file)
    if recorded is not None and driver == "expert":
        raise RoadproofError("the expert needs a map, which recordings do not have; give a --controller")
    return World(spec, device, recorded, scenario)

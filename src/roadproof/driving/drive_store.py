"""The drives of one driver in one scenario, kept in a folder.

    FOLDER/episodes/clear-noon-alone-clean-0123456789ab.npz

Every drive is kept under a name that ends in a hash of all that it depends on, so a drive that is there is not made
again, and one of other inputs is never mistaken for it.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass
from functools import partial
from operator import attrgetter
from pathlib import Path
from typing import Any, TypeAlias, cast

import roadproof
from roadproof.controllers import Controller
from roadproof.controllers.identity import told_of
from roadproof.datatypes import Weather
from roadproof.driving.deviation import path_of, sees_canvas
from roadproof.driving.episode import Episode
from roadproof.driving.rollout import Driver, rollout
from roadproof.driving.starts import NOMINAL, StartOffset
from roadproof.driving.trial import Trial, judge
from roadproof.errors import EpisodeError
from roadproof.io.files import inside
from roadproof.io.identity import ANSWERS, CONTROLLER, digest, stated
from roadproof.io.known import without_addresses
from roadproof.processes import Pool
from roadproof.scenarios import Scenario
from roadproof.scenarios import identity as identity_of_scenario
from roadproof.simulators.protocol import Identified, PaintKind, PatternImage, Simulator, own_digest

CLEAN = "clean"
EPISODES = "episodes"

AnyDriver: TypeAlias = Controller | Driver[Any]


@dataclass(frozen=True, kw_only=True, slots=True)
class DriveConditions:
    """What tells a drive from the others in its folder.

    Args:
        paint: name of what is painted; "clean" is the bare road.
        weather: weather of the drive.
        cars: number of other cars on the road.
        pedestrians: number of pedestrians.
        seed: seed of cars and pedestrians.
        start: offset of the drive's start from the scenario's.
    """

    paint: str
    weather: Weather
    cars: int = 0
    pedestrians: int = 0
    seed: int = 0
    start: StartOffset = NOMINAL


@dataclass(frozen=True, kw_only=True, slots=True, eq=False)
class Episodes:
    """Makes drives that the folder lacks, and judges drives. It can be pickled if its driver can.

    Args:
        driver: controller, or function, that drives.
        scenario: scenario that is driven.
        paints: canvas pictures of what is painted, by name.
        digests: hash of each paint, by name, with the bare road's under "clean".
        folder: folder whose subfolder "episodes" has the drives.
        parts: everything that all drives depend on, by name.
    """

    driver: AnyDriver
    scenario: Scenario
    paints: Mapping[str, PatternImage]
    digests: Mapping[str, str]
    folder: Path
    parts: Mapping[str, object]

    @staticmethod
    def of(
        simulator: Simulator,
        driver: AnyDriver,
        scenario: Scenario,
        paints: Mapping[str, PatternImage],
        folder: Path,
    ) -> Episodes:
        """The store of the drives that a driver makes in a simulator."""
        return Episodes(
            driver=driver,
            scenario=scenario,
            paints=paints,
            digests={name: digest(paint) for name, paint in paints.items()} | {CLEAN: digest()},
            folder=folder,
            parts=_parts(simulator, driver, scenario),
        )

    @property
    def made_of(self) -> dict[str, object]:
        """The parts that identify the drives, with the digests of a driver and of its answers apart from its name."""
        driver, answers, which = cast("list[object]", self.parts["driver"])
        return {**self.parts, "driver": driver, ANSWERS: digest(stated(answers)), CONTROLLER: which}

    def file(self, drive: DriveConditions) -> str:
        """The file name of a drive's episode."""
        parts = [stated(self.parts), self.digests[drive.paint]]
        parts += [drive.weather, str(drive.cars), str(drive.pedestrians), str(drive.seed)]
        parts += [] if drive.start == NOMINAL else [repr(drive.start)]
        among = f"traffic-{drive.seed}" if drive.cars + drive.pedestrians else "alone"
        return f"{drive.weather}-{among}-{drive.paint}-{digest(stated(parts))[:12]}.npz"

    def has(self, drive: DriveConditions) -> bool:
        """Whether a drive is in the folder already."""
        return self._path(drive).exists()

    def make(self, simulator: Simulator, drive: DriveConditions) -> None:
        """Make a drive and keep it; a drive that is in the folder already is left as it is.

        Raises:
            SimulatorError, ControllerError: as `rollout` does.
            OutputError: the folder cannot be written.
        """
        if self.has(drive):
            return
        episode = rollout(
            simulator,
            self.driver,
            drive.start.of(self.scenario),
            weather=drive.weather,
            pattern=self.paints.get(drive.paint),
            cars=drive.cars,
            pedestrians=drive.pedestrians,
            seed=drive.seed,
        )
        self.put(drive, episode)

    def put(self, drive: DriveConditions, episode: Episode) -> None:
        """Keep an episode that was made elsewhere."""
        episode.save(self._path(drive))

    def trial(self, clean: DriveConditions, painted: DriveConditions) -> Trial:
        """What paint did, from two drives that differ in it alone.

        Raises:
            EpisodeError: a drive is missing or damaged.
        """
        return judge(
            Episode.load(self._path(clean)),
            Episode.load(self._path(painted)),
            self.scenario.canvas,
            pattern=painted.paint,
            clean_file=self.file(clean),
            painted_file=self.file(painted),
            start=painted.start,
        )

    def sees_canvas(self, drive: DriveConditions) -> bool:
        """Whether a drive that was made came to where the canvas is in view.

        Raises:
            EpisodeError: the drive is missing or damaged.
        """
        return sees_canvas(path_of(Episode.load(self._path(drive))), self.scenario.canvas)

    def _path(self, drive: DriveConditions) -> Path:
        return self.folder / EPISODES / self.file(drive)


def make_missing(
    pool: Pool[Simulator], episodes: Episodes, drives: Sequence[DriveConditions], on_done: Callable[[int], object]
) -> None:
    """Make the drives that a store lacks.

    Args:
        pool: the processes, each with an open simulator, that make the drives.
        episodes: store of the drives.
        drives: drives that are wanted.
        on_done: called with the number of these drives that are done.

    Raises:
        SimulatorError: a process died, or the simulator refuses the conditions.
        ControllerError: the driver raises, or answers wrongly.
        OutputError: the drives cannot be written.
    """
    missing = [drive for drive in drives if not episodes.has(drive)]
    made = len(drives) - len(missing)
    on_done(made)
    # A simulator lights all it has anew for another weather.
    drives_made = pool.each(partial(_make, episodes), missing, alike=attrgetter("weather"))
    for done, _ in enumerate(drives_made, made + 1):
        on_done(done)


def _make(episodes: Episodes, simulator: Simulator, drive: DriveConditions) -> None:
    episodes.make(simulator, drive)


def load_episodes(folder: Path, names: Iterable[str]) -> tuple[Episode, ...]:
    """Drives by their file names.

    Raises:
        EpisodeError: a drive is missing or damaged.
    """
    return tuple(Episode.load(inside(folder / EPISODES, name, "episode", EpisodeError)) for name in names)


def driver_in_words(driver: AnyDriver) -> str:
    """A controller's type, or a function's name, with what a partial one has been given."""
    if isinstance(driver, partial):
        return without_addresses(f"{driver_in_words(driver.func)} with {driver.args}, {driver.keywords}")
    return type(driver).__name__ if isinstance(driver, Controller) else str(getattr(driver, "__qualname__", driver))


def _parts(simulator: Simulator, driver: AnyDriver, scenario: Scenario) -> dict[str, object]:
    """Everything that all drives depend on, by name."""
    view = simulator.input
    parts: dict[str, object] = {
        "version": roadproof.__version__,
        "simulator": f"{type(simulator).__module__}.{type(simulator).__qualname__}",
        "camera": simulator.camera.stated,
        "input": asdict(view),
        "dt_s": simulator.dt_s,
        "driver": [driver_in_words(driver), *told_of(driver, (view.height_px, view.width_px))],
        "scenario": identity_of_scenario(scenario),
    }
    if simulator.paint is not PaintKind.RENDERED:
        parts["paint"] = simulator.paint
    if isinstance(simulator, Identified) and simulator.identity:
        parts["world"] = simulator.identity
    if own := own_digest(simulator):
        parts["simulator_digest"] = own
    return parts

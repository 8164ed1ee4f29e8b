"""Recorded drives before calibration, and their folder.

    RECORD/record.json         what was asked for: scenario, weather, seed, trajectories, window, camera, input, driver
    RECORD/MAP.xodr            the scenario's map, where that is a file
    RECORD/DRIVE/episode.npz   the whole drive (`driving.episode`)
    RECORD/DRIVE/drive.npz     of the kept frames: frame_number, frames, steer, right_m; and how the drive came about

A drive's folder is there when the drive is finished. Nothing is pickled.
"""

from __future__ import annotations

from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import NotRequired, TypedDict

import numpy as np
from jaxtyping import Float, Int, UInt8

from roadproof.datatypes import VehicleState, Weather
from roadproof.drives.trajectories import Scheme, SteeringNoise, Swerve, Trajectories, Window
from roadproof.driving.episode import Episode
from roadproof.errors import RecordingError
from roadproof.geometry import CameraModel, CropResize
from roadproof.io.files import AnyPath, as_path, check_closed, inside, is_plain_name, write_folder_atomically
from roadproof.io.html import table
from roadproof.io.identity import require_same
from roadproof.io.records import Form, RecordFile
from roadproof.recordings import Side, Track
from roadproof.scenarios import MAP, Scenario, identity, with_map_in


@dataclass(frozen=True, kw_only=True, slots=True, eq=False)
class Drive:
    """One recorded drive and its frames that show the canvas.

    Args:
        name: name of the drive and of its folder.
        side: side to which the drive was perturbed.
        episode: episode of the whole drive; its steering is what was applied.
        frame_number: steps of the episode whose frames are kept, (F,).
        frames: the controller's input at the kept steps, RGB, (F, H, W, 3).
        steer: what the driver answered to each kept frame, in [−1, 1], positive to the right, (F,).
        right_m: offset from the clean drive at each kept frame, metres, positive to the right, (F,).
        calls: number of simulator drives that it took, those given up included.
        note: what the user should know about the drive; empty if there is nothing.

    Raises:
        RecordingError: there is no frame, lengths differ, or a step is not one of the episode.
    """

    name: str
    side: Side
    episode: Episode
    frame_number: Int[np.ndarray, " f"]
    frames: UInt8[np.ndarray, "f h w 3"]
    steer: Float[np.ndarray, " f"]
    right_m: Float[np.ndarray, " f"]
    calls: int = 1
    note: str = ""

    def __post_init__(self) -> None:
        steps, count = self.frame_number, len(self.frames)
        lengths = {values.shape for values in (steps, self.steer, self.right_m)}
        if not count or lengths != {(count,)} or steps.min() < 0 or steps.max() >= len(self.episode):
            raise RecordingError(f"drive {self.name} does not fit its episode of {len(self.episode)} steps")

    @property
    def offset_m(self) -> float:
        """Largest offset from the clean drive in metres, positive to the right."""
        return float(self.right_m[np.abs(self.right_m).argmax()])

    @property
    def states(self) -> tuple[VehicleState, ...]:
        """Pose and speed of the car at each kept frame."""
        return tuple(self.episode.state(step) for step in self.frame_number.tolist())

    @property
    def track(self) -> Track:
        """Poses and controls of all steps of the drive; the last step holds the controls of the one before."""
        episode = self.episode

        def held(values: Float[np.ndarray, " m"]) -> Float[np.ndarray, " n"]:
            return np.append(values, values[-1:] if values.size else 0.0)

        return Track(
            dt_s=episode.dt_s,
            step=np.arange(len(episode)),
            x_m=episode.x_m,
            y_m=episode.y_m,
            yaw_rad=episode.yaw_rad,
            speed_mps=episode.speed_mps,
            steer=held(episode.steer),
            throttle=held(episode.throttle),
            brake=held(episode.brake),
        )


@dataclass(frozen=True, kw_only=True, slots=True)
class Settings:
    """The settings of a recording; two recordings with the same settings are the same recording.

    Args:
        scenario: scenario that was driven.
        weather: weather of all drives.
        trajectories: number of drives and their perturbations.
        window: which frames of each drive are kept.
        seed: seed of the perturbations.
        driver: name of the driver, in words.
        answers: how the controller answers (`controllers.identity`); empty for a function, and in older recordings.
        controller_digest: what tells the driver otherwise; empty where its name is all there is, and in older ones.
        camera: camera on the car.
        view: crop and resize that make the controller's input from the camera picture.
        dt_s: seconds per step.
        world: what tells the simulator (`simulators.protocol.world_of`); empty for the town as software draws it, and
            in older recordings.
    """

    scenario: Scenario
    weather: Weather
    trajectories: Trajectories
    window: Window
    seed: int
    driver: str
    camera: CameraModel
    view: CropResize
    dt_s: float
    answers: str = ""
    controller_digest: str = ""
    world: str = ""


@dataclass(frozen=True, kw_only=True, slots=True, eq=False)
class Drives:
    """The recorded drives of one scenario, not calibrated yet.

    Args:
        settings: settings of the recording.
        drives: the recorded drives, the clean one first.

    Raises:
        RecordingError: there is no drive, or the first is not the clean one.
    """

    settings: Settings
    drives: tuple[Drive, ...]

    def __post_init__(self) -> None:
        if not self.drives or self.drives[0].side is not Side.CLEAN:
            raise RecordingError("the recording has no clean drive in the first place; record it again")

    @property
    def calls(self) -> int:
        """Number of drives the simulator made, those given up included."""
        return sum(drive.calls for drive in self.drives)

    def _repr_html_(self) -> str:
        """How a notebook shows it: a row for each drive."""
        head = ("drive", "frames", "furthest from the clean drive, m", "note")
        return table(head, [(each.name, len(each.frames), f"{each.offset_m:+.2f}", each.note) for each in self.drives])

    def save(self, folder: AnyPath) -> None:
        """Write the folder that `record` fills where it is given one.

        Raises:
            RecordingError: the folder holds a recording with other settings.
            OutputError: the folder holds one of the drives already, or cannot be written.
        """
        folder = as_path(folder)
        write_settings(self.settings, folder)
        for drive in self.drives:
            write_drive(drive, folder)

    @staticmethod
    def load(folder: AnyPath) -> Drives:
        """Read a finished recording, of `save` or of `record`.

        Raises:
            RecordingError: the folder is missing, damaged, or not finished; the message says what to do.
            EpisodeError: an episode in it is damaged.
        """
        folder = as_path(folder)
        settings = read_settings(folder)
        plans = settings.trajectories.plans()
        drives = [read_drive(plan.name, folder) for plan in plans]
        missing = [plan.name for plan, drive in zip(plans, drives, strict=True) if drive is None]
        if missing:
            raise RecordingError(
                f"{folder} lacks the drive {missing[0]}; give the same `roadproof record` again to finish"
            )
        return Drives(settings=settings, drives=tuple(drive for drive in drives if drive is not None))


def write_settings(settings: Settings, folder: Path) -> bool:
    """Write the settings of a recording, which begins its folder; says whether it was not begun before.

    Raises:
        RecordingError: the folder holds a recording with other settings; the message names the first difference.
        OutputError: the folder cannot be written.
    """
    path, scenario = folder / "record.json", identity(settings.scenario)
    if path.exists():
        content = _SETTINGS.content(path)
        _SETTINGS.made(path, content)  # damage is named as such
        stored = content["scenario"]["map_name"]
        known = content["scenario"] | {"map_name": Path(stored).name, "map": content.get("map", "")}
        if known["map"] and known["map"] == scenario["map"]:
            # The same road, whatever its file is called.
            scenario["map_name"] = known["map_name"]
        # Recordings of the town as software draws it are older than this word.
        before = {"world": ""} | content | {"scenario": known}
        now = _SETTINGS.stated(settings) | {"scenario": scenario}
        require_same(folder, "a recording", before, now, RecordingError)
        # Older recordings name a map that lies elsewhere; and a copy may be lost.
        if scenario["map"] and not (is_plain_name(stored) and (folder / stored).is_file()):
            _write(settings, folder, scenario["map"])
        return False
    _write(settings, folder, scenario["map"])
    return True


def _write(settings: Settings, folder: Path, digest_of_map: str) -> None:
    """Write record.json, and the scenario's map beside it where that is a file."""
    told: dict[str, str] = {}
    if digest_of_map:
        own = with_map_in(folder, settings.scenario)
        settings = replace(settings, scenario=replace(own, map_name=Path(own.map_name).name))
        told["map"] = digest_of_map
    _SETTINGS.write(folder / "record.json", settings, **told)


def forget_settings(settings: Settings, folder: Path) -> None:
    """Take the settings of a recording away again, of which no drive could be made, and its folder if it is empty."""
    path, own = folder / "record.json", Path(settings.scenario.map_name)
    name = _SETTINGS.read(path).scenario.map_name
    # What lay there before was not copied, and stays; where there was no such file, none was.
    if own.suffix == MAP and own.resolve().parent != folder.resolve() and is_plain_name(name):
        (folder / name).unlink(missing_ok=True)
    path.unlink(missing_ok=True)
    with suppress(OSError):
        folder.rmdir()


def write_drive(drive: Drive, folder: Path) -> None:
    """Write one finished drive to `folder`/its name, all or nothing.

    Raises:
        OutputError: the drive cannot be written.
    """

    def write(part: Path) -> None:
        drive.episode.save(part / "episode.npz")
        _DRIVE.write(part / "drive.npz", drive)

    write_folder_atomically(folder / drive.name, write)


def read_drive(name: str, folder: Path) -> Drive | None:
    """A finished drive of a recording; None if it is not finished.

    Raises:
        RecordingError: the drive is damaged.
        EpisodeError: the episode of the drive is damaged.
    """
    path = folder / name / "drive.npz"
    if not path.parent.is_dir():
        return None
    return _DRIVE.read(path, name=name, episode=Episode.load(path.with_name("episode.npz")))


def read_settings(folder: Path) -> Settings:
    """Read the settings of a recording alone, whether it is finished or not.

    Raises:
        RecordingError: the folder is missing or damaged, or lacks its map.
    """
    path = folder / "record.json"
    if not path.is_file():
        raise RecordingError(f"{folder} has no record.json; expected what `roadproof record` writes")
    check_closed(folder, RecordingError)
    settings = _SETTINGS.read(path)
    if not settings.scenario.map_name.endswith(MAP):
        return settings
    name, cure = settings.scenario.map_name, "give the same `roadproof record` again, which copies it there"
    if not is_plain_name(name):
        raise RecordingError(f"{path}: map_name is {name!r:.120}, expected the name of a file beside it; {cure}")
    own = inside(folder, name, f"{path}: map_name", RecordingError)
    if not own.is_file():
        raise RecordingError(f"{folder} lacks {own.name}, the map of its scenario; {cure}")
    return replace(settings, scenario=replace(settings.scenario, map_name=str(own.resolve())))


def require_same_map(settings: Settings, folder: Path) -> None:
    """Refuse to go on with drives in whose map something has changed since: they would be of another road.

    Raises:
        RecordingError: the map has changed, or the folder is damaged.
    """
    known = _SETTINGS.content(folder / "record.json").get("map", "")
    if known and identity(settings.scenario)["map"] != known:
        raise RecordingError(
            f"{settings.scenario.map_name} has changed since the drives in {folder} were recorded on it; record again"
        )


class _Trajectories(TypedDict):
    """Trajectories as record.json stores them: flat, with the keys of one kind of perturbation."""

    count: int
    scheme: Scheme
    swerve_m: NotRequired[tuple[float, ...]]
    weave_m: NotRequired[tuple[float, ...]]
    noise_deg: NotRequired[tuple[int, int]]


def _stated(trajectories: Trajectories) -> dict[str, object]:
    how = trajectories.perturbation
    stated: dict[str, object] = {"count": trajectories.count, "scheme": trajectories.scheme}
    if isinstance(how, SteeringNoise):
        return stated | {"noise_deg": (how.low_deg, how.high_deg)}
    return stated | {"swerve_m": how.swerves_m} | ({"weave_m": how.weaves_m} if how.weaves_m else {})


def _meant(stated: _Trajectories) -> Trajectories:
    noise = stated.get("noise_deg")
    how = SteeringNoise(*noise) if noise else Swerve(stated.get("swerve_m", ()), stated.get("weave_m", ()))
    return Trajectories(count=stated["count"], scheme=stated["scheme"], perturbation=how)


_SETTINGS = RecordFile(
    kind=Settings,
    name="roadproof-record",
    error=RecordingError,
    remedy="record it again",
    forms={
        "trajectories": Form(_Trajectories, _stated, _meant),
        "camera": Form(CameraModel, lambda camera: camera.stated, lambda camera: camera),
    },
)
_DRIVE = RecordFile(
    kind=Drive,
    error=RecordingError,
    remedy="remove its folder and record it again",
    elsewhere=("name", "episode"),
    header="about",
)

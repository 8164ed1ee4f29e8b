"""Recorded drives before calibration, and their folder.

    RECORD/record.json         what was asked for: scenario, weather, seed, trajectories, window, camera, input, driver
    RECORD/DRIVE/episode.npz   the whole drive (`driving.episode`)
    RECORD/DRIVE/drive.npz     of the kept frames: frame_number, frames, steer, right_m; and how the drive came about

A drive's folder is there when the drive is finished. Nothing is pickled.
"""

from __future__ import annotations

import json
from dataclasses import asdict, astuple, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, Int, UInt8

from roadproof.datatypes import VehicleState, Weather
from roadproof.drives.trajectories import Scheme, SteeringNoise, Swerve, Trajectories, Window
from roadproof.driving.episode import Episode
from roadproof.errors import RecordingError, RoadproofError
from roadproof.geometry import CameraModel, CanvasPlacement, CropResize
from roadproof.io.arrays import read_record, write_archive
from roadproof.io.files import read_json, write_atomically, write_folder_atomically
from roadproof.recordings import Push, Track
from roadproof.scenarios import Scenario

FORMAT = "roadproof-record"
FORMAT_VERSION = 1
_ABOUT = "about"
_PER_FRAME = ("frame_number", "frames", "steer", "right_m")


@dataclass(frozen=True, kw_only=True, slots=True, eq=False)
class Drive:
    """One recorded drive and its frames that show the canvas.

    Args:
        name: names its folder.
        push: how it was perturbed.
        episode: the whole drive; its steer is what was done.
        frame_number: step of each kept frame, rising.
        frames: the controller's input there, (F, H, W, 3).
        steer: what the driver answered to each of them.
        right_m: offset from the clean drive at each of them, positive to the right.
        calls: drives it took, those given up included.
        note: what the user should know; empty where there is nothing.
    """

    name: str
    push: Push
    episode: Episode
    frame_number: Int[np.ndarray, " f"]
    frames: UInt8[np.ndarray, "f h w 3"]
    steer: Float[np.ndarray, " f"]
    right_m: Float[np.ndarray, " f"]
    calls: int = 1
    note: str = ""

    @property
    def deviation_m(self) -> float:
        """Largest offset from the clean drive, positive to the right."""
        return float(self.right_m[np.abs(self.right_m).argmax()])

    @property
    def states(self) -> tuple[VehicleState, ...]:
        """Where the car was at each kept frame."""
        return tuple(self.episode.state(step) for step in self.frame_number.tolist())

    @property
    def track(self) -> Track:
        """Poses and controls of all its steps; what was given last is held at the last one."""
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
    """What was asked of a recording; two with the same settings are the same recording.

    Args:
        scenario: that was driven.
        weather: of all drives.
        trajectories: which drives.
        window: which frames are kept.
        seed: of the perturbations.
        driver: who drove, in words.
        answers: which controller that is (`controllers.identity`); empty for a function, and in recordings older than
            the word.
        camera: on the car.
        view: how the controller's input is made from its picture.
        dt_s: seconds a step.
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


@dataclass(frozen=True, kw_only=True, slots=True, eq=False)
class Drives:
    """The recorded drives of one scenario, not calibrated yet.

    Args:
        settings: what was asked for.
        drives: the clean one first.

    Raises:
        RecordingError: there is no drive, or the first is not the clean one.
    """

    settings: Settings
    drives: tuple[Drive, ...]

    def __post_init__(self) -> None:
        if not self.drives or self.drives[0].push is not Push.CLEAN:
            raise RecordingError("the recording has no clean drive in the first place; record it again")

    @property
    def calls(self) -> int:
        """Drives the simulator made."""
        return sum(drive.calls for drive in self.drives)


def write_settings(settings: Settings, folder: Path) -> None:
    """Begin the folder of a recording.

    Raises:
        RecordingError: it holds a recording with other settings; the message names the first.
        OutputError: it cannot be written.
    """
    path, content = folder / "record.json", _to_json(settings)
    if path.exists():
        before = read_json(path, FORMAT, FORMAT_VERSION, RecordingError)
        same = before.get("driver") == settings.driver
        if same and before.setdefault("answers", settings.answers) != settings.answers:
            raise RecordingError(
                f"{folder} holds a recording of another {settings.driver or 'driver'}, which answers otherwise, as "
                "before a training; choose another folder, or remove it"
            )
        for key, value in content.items():
            if before.get(key) != value:
                raise RecordingError(
                    f"{folder} holds a recording with {key} {before.get(key)!r}, now it is {value!r}; "
                    "choose another folder"
                )
        return
    write_atomically(path, lambda part: part.write_text(json.dumps(content, indent=1, ensure_ascii=False) + "\n"))


def write_drive(drive: Drive, folder: Path) -> None:
    """Write one finished drive to `folder`/its name, all or nothing.

    Raises:
        OutputError: it cannot be written.
    """

    def write(part: Path) -> None:
        drive.episode.save(part / "episode.npz")
        about = {"push": str(drive.push), "calls": drive.calls, "note": drive.note}
        arrays: dict[str, Any] = {name: getattr(drive, name) for name in _PER_FRAME}
        write_archive(part / "drive.npz", arrays | {_ABOUT: np.array(json.dumps(about))})

    write_folder_atomically(folder / drive.name, write)


def read_drive(name: str, folder: Path) -> Drive | None:
    """A finished drive of a recording, or None where it is not finished.

    Raises:
        RecordingError: it is damaged.
        EpisodeError: its episode is.
    """
    path = folder / name / "drive.npz"
    if not path.parent.is_dir():
        return None
    remedy = f"remove {path.parent} and record it again"
    about, stored = read_record(path, _PER_FRAME, RecordingError, remedy, header=_ABOUT)
    arrays: dict[str, Any] = stored
    try:
        drive = Drive(
            name=name,
            push=Push(about["push"]),
            episode=Episode.load(path.with_name("episode.npz")),
            calls=int(about["calls"]),
            note=str(about["note"]),
            **arrays,
        )
    except (KeyError, TypeError, ValueError) as error:
        raise RecordingError(f"{path} is damaged ({error}); {remedy}") from None
    steps = len(drive.episode)
    counts = {len(values) for values in (drive.frame_number, drive.frames, drive.steer, drive.right_m)}
    if counts != {len(drive.frames)} or not len(drive.frames) or int(drive.frame_number.max()) >= steps:
        raise RecordingError(f"{path} does not fit its episode of {steps} steps; remove {path.parent}, record it again")
    return drive


def load_drives(folder: Path) -> Drives:
    """Read a finished recording.

    Raises:
        RecordingError: the folder is missing, damaged, or not finished; the message says what to do.
        EpisodeError: an episode in it is damaged.
    """
    if not (folder / "record.json").is_file():
        raise RecordingError(f"{folder} has no record.json; expected what `roadproof record` writes")
    settings = _from_json(read_json(folder / "record.json", FORMAT, FORMAT_VERSION, RecordingError), folder)
    plans = settings.trajectories.plans()
    drives = [read_drive(plan.name, folder) for plan in plans]
    missing = [plan.name for plan, drive in zip(plans, drives, strict=True) if drive is None]
    if missing:
        raise RecordingError(f"{folder} lacks the drive {missing[0]}; give the same `roadproof record` again to finish")
    return Drives(settings=settings, drives=tuple(drive for drive in drives if drive is not None))


def _to_json(settings: Settings) -> dict[str, Any]:
    trajectories, how = settings.trajectories, settings.trajectories.perturbation
    content = {
        "format": FORMAT,
        "version": FORMAT_VERSION,
        **asdict(settings),
        "trajectories": {
            "count": trajectories.count,
            "scheme": str(trajectories.scheme),
            **_told(how),
        },
    }
    return json.loads(json.dumps(content))  # tuples become lists, as they will be read


def _told(how: Swerve | SteeringNoise) -> dict[str, Any]:
    if isinstance(how, SteeringNoise):
        return {"noise_deg": astuple(how)}
    return {"swerve_m": how.deviations_m} | ({"weave_m": how.weaves_m} if how.weaves_m else {})


def _from_json(content: dict[str, Any], folder: Path) -> Settings:
    try:
        scenario, chosen = content["scenario"], content["trajectories"]
        return Settings(
            scenario=Scenario(
                **scenario
                | {
                    "start": VehicleState(**scenario["start"]),
                    "canvas": CanvasPlacement(**scenario["canvas"]),
                    "goal_m": (float(scenario["goal_m"][0]), float(scenario["goal_m"][1])),
                }
            ),
            weather=Weather(content["weather"]),
            trajectories=Trajectories(
                count=chosen["count"],
                scheme=Scheme(chosen["scheme"]),
                perturbation=Swerve(tuple(map(float, chosen["swerve_m"])), tuple(map(float, chosen.get("weave_m", ()))))
                if "swerve_m" in chosen
                else SteeringNoise(*map(int, chosen["noise_deg"])),
            ),
            window=Window(**content["window"]),
            seed=int(content["seed"]),
            driver=str(content["driver"]),
            camera=CameraModel(**content["camera"]),
            view=CropResize(**content["view"]),
            dt_s=float(content["dt_s"]),
        )
    except (KeyError, TypeError, ValueError, AttributeError, RoadproofError) as error:
        raise RecordingError(f"{folder / 'record.json'} is incomplete or damaged ({error}); record it again") from None

"""The verb: recorded drives in, recordings ready for attacks out."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from dataclasses import astuple, dataclass, field
from enum import StrEnum
from functools import partial
from itertools import repeat
from pathlib import Path
from typing import NamedTuple

import numpy as np

from roadproof.calibration.published import (
    PAINTS,
    RUNS,
    colour_targets,
    colours_from_paints,
    homographies_from_points,
    point_targets,
)
from roadproof.calibration.replays import Replays, Wanted, replay_in, told_apart
from roadproof.calibration.report import CalibrationReport, DriveReport, Geometry, Spread, stated_errors_px
from roadproof.calibration.two_paint import TARGETS, look_at_paints
from roadproof.datatypes import Obstacle, Weather
from roadproof.drives import Drive, Drives
from roadproof.errors import CalibrationError
from roadproof.geometry import CameraModel, CanvasPlacement, homography_from_pose
from roadproof.homographies import Homographies
from roadproof.io.files import AnyPath, as_path
from roadproof.io.html import table
from roadproof.io.identity import digest, require_same
from roadproof.photometry import AffineResponse, ColourTransform, PixelMaps
from roadproof.processes import Pool, open_or_here
from roadproof.recordings import Recording, RecordingSet, load_recordings, save_recordings
from roadproof.roads.marks import LaneMark, marks_of
from roadproof.scenarios import Scenario
from roadproof.simulators.protocol import Simulator, obstacles_of, world_of

WORST_PX = 3.0
LEAST_SHARE = 0.5


class CalibrationMethod(StrEnum):
    """How drives are calibrated.

    two-paint: the canvas white, and black with grey squares, two replays a drive; homographies from its outline.
    pose: the same paints; homographies from the camera model and the poses, unrefined.
    published: 12 replays a drive over coloured points, 22 of the clean drive over painted colours.
    """

    TWO_PAINT = "two-paint"
    POSE = "pose"
    PUBLISHED = "published"


METHODS = tuple(CalibrationMethod)


@dataclass(frozen=True, slots=True)
class Calibrated:
    """A finished calibration, and its place in the folder of a run.

    RUN/calibration/report.json   how good it is
    RUN/recordings/               the recordings; there when the calibration is finished
    """

    recordings: RecordingSet
    report: CalibrationReport
    made_of: Mapping[str, object] = field(default_factory=dict[str, object])
    """The method and a digest of every drive, which tell it from another calibration."""

    def _repr_html_(self) -> str:
        """How a notebook shows it: a row for each drive."""
        head = ("drive", "frames", "dropped", "misses what was seen by, px", "misses what the simulator states by, px")
        return table(head, map(_shown, self.report.drives))

    def save(self, run: AnyPath) -> None:
        """Write report and recordings, the recordings last, since their presence says that the calibration is finished.

        Raises:
            OutputError: the files cannot be written.
        """
        run = as_path(run)
        CalibrationReport.FILE.write(run / "calibration" / "report.json", self.report, made_of=self.made_of)
        save_recordings(self.recordings, run / "recordings")

    @staticmethod
    def load(run: AnyPath) -> Calibrated:
        """Read what `save` wrote.

        Raises:
            CalibrationError, RecordingError: a file is missing or damaged.
        """
        run = as_path(run)
        path = run / "calibration" / "report.json"
        content = CalibrationReport.FILE.content(path)
        report = CalibrationReport.FILE.made(path, content)
        return Calibrated(load_recordings(run / "recordings"), report, content.get("made_of", {}))

    @staticmethod
    def kept(run: Path, drives: Drives, method: CalibrationMethod) -> Calibrated | None:
        """Read what `save` wrote; None if the run has not been calibrated.

        Args:
            run: path of the run folder.
            drives: drives of which it must be a calibration.
            method: calibration method with which it must have been made.

        Raises:
            CalibrationError, RecordingError: a file is missing or damaged, or drives or method are not the stored ones.
        """
        if not (run / "recordings").exists():
            return None
        found = Calibrated.load(run)
        now = _parts(drives, method)
        # Calibrations are older than the last two parts; one that says none of them is nobody's.
        canvas = found.recordings.canvas or drives.settings.scenario.canvas
        known = {"canvas": _numbers(canvas), "world": now["world"], **found.made_of} if found.made_of else {}
        require_same(run / "recordings", "a calibration", known, now, CalibrationError)
        for recording in found.recordings.recordings:
            if not _same_frames(recording, drives):
                raise CalibrationError(
                    f"{run / 'recordings'}: drive {recording.name} has other frames than were recorded in this run; "
                    "remove that folder, and the drives are calibrated again"
                )
        return found


def _shown(drive: DriveReport) -> tuple[object, ...]:
    seen, stated = ("" if each is None else f"{each.mean:.2f}" for each in (drive.residual_px, drive.stated_px))
    return drive.name, drive.frames, len(drive.dropped), seen, stated


def _same_frames(recording: Recording, drives: Drives) -> bool:
    """Whether the frames of a calibrated recording are those of the drive of its name; it may lack some."""
    drive = next((drive for drive in drives.drives if drive.name == recording.name), None)
    if drive is None:
        return False
    kept = np.isin(drive.frame_number, recording.frame_number)
    return kept.sum() == len(recording.frames) and np.array_equal(drive.frames[kept], recording.frames)


def _parts(drives: Drives, method: CalibrationMethod) -> dict[str, object]:
    settings = drives.settings
    return {
        "method": str(method),
        "drives": {drive.name: digest(*told_apart(drive))[:16] for drive in drives.drives},
        "canvas": _numbers(settings.scenario.canvas),
        "world": settings.world,
    }


def _numbers(canvas: CanvasPlacement) -> list[float]:
    return list(map(float, astuple(canvas)))


def replays_needed(count: int, method: CalibrationMethod) -> int:
    """Number of replays in the simulator that a calibration of so many recorded drives takes on top of them."""
    return RUNS * count + len(PAINTS) if method is CalibrationMethod.PUBLISHED else len(TARGETS) * count


def _wanted(drives: Drives, method: CalibrationMethod) -> list[Wanted]:
    """The replays of a calibration."""
    if method is not CalibrationMethod.PUBLISHED:
        return [(drive, target) for drive in drives.drives for target in TARGETS]
    points, clean = point_targets(), drives.drives[0]
    return [
        *((drive, target) for drive in drives.drives for target in points),
        *((clean, target) for target in colour_targets()),
    ]


def calibrate(
    simulator: Simulator,
    drives: Drives,
    method: CalibrationMethod = CalibrationMethod.TWO_PAINT,
    *,
    folder: AnyPath | None = None,
    pool: Pool[Simulator] | None = None,
    on_call: Callable[[int], object] = lambda _done: None,
) -> Calibrated:
    """Find out where the canvas is in every frame of recorded drives, and how paint looks there.

    Args:
        simulator: an open simulator, the one the drives were recorded in.
        drives: the recorded drives that `drives.record` returned.
        method: calibration method, two-paint by default.
        folder: folder that keeps every replay; those it holds already are not driven again. None keeps nothing.
        pool: processes that are open already and make the replays, where a folder keeps them.
        on_call: called with the number of replays so far, at first 0.

    Raises:
        CalibrationError: a replay goes astray, or the calibration of a drive cannot be trusted; the message says why.
        SimulatorError, ScenarioError: as `rollout` does.
        OutputError: the folder cannot be written.
    """
    folder = None if folder is None else as_path(folder)
    settings = drives.settings
    if (simulator.camera, simulator.input, simulator.dt_s) != (settings.camera, settings.view, settings.dt_s):
        raise CalibrationError(
            "the simulator has another camera, crop or time step than when the drives were recorded; set it up as it "
            "was then"
        )
    if world_of(simulator) != settings.world:
        told = " and ".join(each or "the town as software draws it" for each in (settings.world, world_of(simulator)))
        raise CalibrationError(
            f"the drives were recorded in another simulator: {told}; calibrate where they were recorded"
        )
    on_call(0)
    began = time.perf_counter()
    beside = None
    if pool is not None and pool.processes > 1 and folder is not None:
        replay_in(pool, drives, folder, _wanted(drives, method), on_call)
        replays, beside = Replays(simulator, drives, folder), pool
    else:
        replays = Replays(simulator, drives, folder, on_call)
    if method is CalibrationMethod.PUBLISHED:
        geometry = [homographies_from_points(replays, drive, settings.camera) for drive in drives.drives]
        looks = [_Look(each, None, replays.stated(drive)) for drive, each in zip(drives.drives, geometry, strict=True)]
        colour, residual = colours_from_paints(replays, drives, drives.drives[0], geometry[0].found)
    else:
        if beside is None or folder is None:
            looks = [_look(replays, drives, method, drive) for drive in drives.drives]
        else:
            names = [drive.name for drive in drives.drives]
            found = dict(beside.each(partial(_look_beside, drives, folder, method), names))
            looks = [found[name] for name in names]
        colour, residual = ColourTransform(AffineResponse.identity()), None
    for drive, look in zip(drives.drives, looks, strict=True):
        _check(drive, look.geometry)
    report = CalibrationReport(
        method=str(method),
        drives=tuple(map(_report, drives.drives, looks, repeat(settings.camera))),
        colour_residual=residual,
        calls=drives.calls + replays_needed(len(drives.drives), method),
        seconds=time.perf_counter() - began,
    )
    with open_or_here(beside, simulator) as there:
        ((_, (marks, obstacles)),) = there.each(_roadside, [settings.scenario])
    recordings = RecordingSet(
        camera=settings.camera,
        view=settings.view,
        colour=colour,
        recordings=tuple(map(_recording, drives.drives, looks, repeat(settings.weather))),
        origin=f"{settings.scenario.name}, {settings.weather}, driven by {settings.driver or 'a driver'}, {method}",
        canvas=settings.scenario.canvas,
        marks=marks,
        obstacles=obstacles,
    )
    return Calibrated(recordings, report, _parts(drives, method))


def _poses(drives: Drives, drive: Drive) -> Homographies:
    """The homographies of a drive's poses, canvas px to camera px."""
    camera, canvas = drives.settings.camera, drives.settings.scenario.canvas
    return np.stack([homography_from_pose(camera, state, canvas) for state in drive.states])


def _roadside(
    simulator: Simulator, scenario: Scenario
) -> tuple[tuple[LaneMark, ...] | None, tuple[Obstacle, ...] | None]:
    """What lies and stands beside a canvas; one that has drawn the road has its plan at hand."""
    return marks_of(simulator, scenario), obstacles_of(simulator, scenario)


class _Look(NamedTuple):
    """What replays say of one drive, and the homographies that the simulator states."""

    geometry: Geometry
    maps: PixelMaps | None
    stated: Homographies | None


def _look(replays: Replays, drives: Drives, method: CalibrationMethod, drive: Drive) -> _Look:
    prior, camera, view = _poses(drives, drive), drives.settings.camera, drives.settings.view
    refine = method is CalibrationMethod.TWO_PAINT
    geometry, maps = look_at_paints(replays, drive, prior, camera, view, refine=refine)
    return _Look(geometry, maps, replays.stated(drive))


def _look_beside(drives: Drives, folder: Path, method: CalibrationMethod, simulator: Simulator, name: str) -> _Look:
    """The same from the replays in a folder."""
    drive = next(each for each in drives.drives if each.name == name)
    return _look(Replays(simulator, drives, folder), drives, method, drive)


def _check(drive: Drive, geometry: Geometry) -> None:
    """Refuse a drive's calibration on which an attack should not be built."""
    count, left = len(drive.frames), len(geometry.found)
    if left < LEAST_SHARE * count:
        first = next(iter(geometry.dropped.values()))
        raise CalibrationError(
            f"drive {drive.name} has {left} of {count} frames left after calibration (first reason: {first}); record "
            "nearer to the canvas (a smaller horizon), check camera model, poses and where the canvas lies, or choose "
            "another method or scenario"
        )
    error = float(np.mean(geometry.residuals_px)) if geometry.residuals_px.size else 0.0
    if error > WORST_PX:
        raise CalibrationError(
            f"the homographies of drive {drive.name} miss what was seen by {error:.1f} px on average, expected at most "
            f"{WORST_PX:g}; check camera model, poses and where the canvas lies"
        )


def _report(drive: Drive, look: _Look, camera: CameraModel) -> DriveReport:
    geometry, stated = look.geometry, look.stated
    kept = list(geometry.found)
    homographies = np.stack(list(geometry.found.values()))
    return DriveReport(
        name=drive.name,
        frames=len(kept),
        dropped=tuple((int(drive.frame_number[k]), reason) for k, reason in geometry.dropped.items()),
        residual_px=Spread.of(geometry.residuals_px),
        stated_px=None if stated is None else Spread.of(stated_errors_px(homographies, stated[kept], camera)),
    )


def _recording(drive: Drive, look: _Look, weather: Weather) -> Recording:
    kept = list(look.geometry.found)
    steps = drive.frame_number[kept]
    return Recording(
        name=drive.name,
        side=drive.side,
        frames=drive.frames[kept],
        frame_number=steps,
        image_from_canvas=np.stack(list(look.geometry.found.values())),
        speed_mps=drive.episode.speed_mps[steps],
        command=drive.episode.command[steps],
        steer=drive.steer[kept],
        maps=look.maps,
        track=drive.track,
        weather=str(weather),
    )

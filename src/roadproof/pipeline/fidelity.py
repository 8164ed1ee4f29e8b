"""The surrogate against the simulator: composited frames of a drive beside rendered ones from the same places."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Bool, Float, Int, UInt8

from roadproof.attacks import show_pattern
from roadproof.attacks.groups import Direction, Group
from roadproof.compositing import covered_share
from roadproof.controllers import Controller
from roadproof.controllers.asking import steer_of
from roadproof.datatypes import Weather
from roadproof.driving.episode import Episode
from roadproof.driving.rollout import look_again, rollout
from roadproof.errors import EpisodeError, RecordingError
from roadproof.io.records import RecordFile, Saved
from roadproof.patterns import Pattern, raster
from roadproof.processes import Pool, open_or_here
from roadproof.recordings import Recording, RecordingSet
from roadproof.scenarios import Scenario
from roadproof.simulators.protocol import PatternImage, Simulator

FIDELITY = "fidelity.npz"


@dataclass(frozen=True, kw_only=True, slots=True)
class Agreement:
    """How well composited frames stand for rendered ones of the same drive.

    Args:
        frames: number of frames that were compared.
        paint_error: mean absolute difference within the paint, in 8-bit levels.
        elsewhere_error: mean absolute difference off the paint, where both should show bare road, in 8-bit levels.
        steer_error: the mean absolute difference between the controller's answers, in steer units.
        predicted_shift: mean shift of steering per frame that the composites predict, positive to the right.
        rendered_shift: mean shift of steering per frame on the rendered frames, positive to the right.
    """

    frames: int
    paint_error: float
    elsewhere_error: float
    steer_error: float
    predicted_shift: float
    rendered_shift: float


@dataclass(frozen=True, kw_only=True, slots=True, eq=False)
class Fidelity(Saved):
    """One recorded drive three times: as it was, with a pattern composited in, and with the pattern really there.

    Args:
        drive: the name of the recorded drive.
        frame_number: the step of each frame in its drive.
        clean: frames without paint, RGB, (F, H, W, 3).
        composited: the same frames with the pattern composited in, (F, H, W, 3).
        rendered: the same frames as the simulator renders them over the real paint, (F, H, W, 3).
        clean_steer: controller's answers to the clean frames, steer units, positive to the right, (F,).
        composited_steer: controller's answers to the composited frames, which the search predicts with, (F,).
        rendered_steer: controller's answers to the rendered frames, (F,).
        agreement: summary of how close composited and rendered frames are.
    """

    drive: str
    frame_number: Int[np.ndarray, " f"]
    clean: UInt8[np.ndarray, "f h w 3"]
    composited: UInt8[np.ndarray, "f h w 3"]
    rendered: UInt8[np.ndarray, "f h w 3"]
    clean_steer: Float[np.ndarray, " f"]
    composited_steer: Float[np.ndarray, " f"]
    rendered_steer: Float[np.ndarray, " f"]
    agreement: Agreement


Fidelity.FILE = RecordFile(
    kind=Fidelity, name="roadproof-fidelity", error=EpisodeError, remedy="evaluate again", level=1
)


def measure_fidelity(
    simulator: Simulator,
    controller: Controller,
    scenario: Scenario,
    pattern: Pattern,
    recordings: RecordingSet,
    folder: Path,
    *,
    weather: Weather,
    clean: Episode | None = None,
    device: torch.device | str = "cpu",
    pool: Pool[Simulator] | None = None,
) -> Fidelity | None:
    """Render the clean drive of a set over the real paint, compare with composites, and keep what came of it.

    Args:
        simulator: an open simulator of the kind that the set was recorded in.
        controller: controller that drove; it computes on `device`.
        scenario: scenario that the set was recorded in.
        pattern: pattern that is painted; one pattern, not a batch.
        recordings: calibrated set of recordings.
        folder: the folder of the evaluation, which gets fidelity.npz.
        weather: the weather in which the set was recorded.
        clean: the clean drive that was recorded; driven again where it is not given.
        device: torch device on which frames are composited.
        pool: processes that are open already, one of which renders instead.

    Returns:
        The comparison; None where the set holds no clean drive, or one that this controller would not drive here, and
        where no recorded frame shows any of the paint.

    Raises:
        OutputError: the folder cannot be written.
    """
    recorded = recordings.clean
    (folder / FIDELITY).unlink(missing_ok=True)  # perhaps of other paint
    if recorded is None:
        return None
    if clean is None:
        clean = rollout(simulator, controller, scenario, weather=weather)
    if not is_drive_of(recorded, clean) or not _covered(pattern, recordings, recorded).any():
        return None
    with open_or_here(pool, simulator) as rendering:
        asked = partial(_rendered, scenario, clean, recorded.frame_number)
        ((_, rendered),) = rendering.each(asked, [raster(pattern)])
    fidelity = compare_with_rendered(pattern, recordings, controller, rendered, drive=recorded.name, device=device)
    fidelity.save(folder / FIDELITY)
    return fidelity


def compare_with_rendered(
    pattern: Pattern,
    recordings: RecordingSet,
    controller: Controller,
    rendered: UInt8[np.ndarray, "f h w 3"],
    *,
    drive: str = "clean",
    device: torch.device | str = "cpu",
) -> Fidelity:
    """Composite a pattern into a recorded drive and compare with the same frames rendered over the real paint.

    Any drive will do that was recorded and calibrated without paint: the clean one, a perturbed one, or the attacked
    one replayed over the bare road.

    Args:
        pattern: pattern that was painted; one pattern, not a batch.
        recordings: calibrated set of recordings.
        controller: controller whose answers are compared; it computes on `device`.
        rendered: the simulator's frames over the paint, one for each of the drive's (`rendered_frames`).
        drive: the name of one drive of the set.
        device: torch device on which frames are composited.

    Raises:
        RecordingError: there is no such drive, or it has another number or size of frames.
        EpisodeError: no frame shows paint.
    """
    recorded = next((each for each in recordings.recordings if each.name == drive), None)
    if recorded is None:
        names = ", ".join(each.name for each in recordings.recordings)
        raise RecordingError(f"the set has no drive {drive!r}, expected one of {names}")
    if rendered.shape != recorded.frames.shape:
        raise RecordingError(
            f"drive {drive} has frames of shape {recorded.frames.shape}, the rendered ones {rendered.shape}; "
            "render the same frames"
        )
    alone = replace(recordings, recordings=(recorded,))
    shown = show_pattern(pattern, alone, controller, Group((recorded.side,), Direction.EITHER), device=device)[0]
    with torch.no_grad():
        frames = torch.as_tensor(rendered, device=device).permute(0, 3, 1, 2).float() / 255
        speed = torch.as_tensor(recorded.speed_mps, device=device, dtype=torch.float32)
        command = torch.as_tensor(recorded.command, device=device, dtype=torch.int64)
        answers = steer_of(controller, frames, speed, command).float().cpu().numpy()
    steer = {"clean_steer": shown.clean_steer, "composited_steer": shown.painted_steer, "rendered_steer": answers}
    return Fidelity(
        drive=drive,
        frame_number=recorded.frame_number,
        clean=recorded.frames,
        composited=shown.painted,
        rendered=rendered,
        agreement=agreement(shown.painted, rendered, _covered(pattern, recordings, recorded), **steer),
        **steer,
    )


def rendered_frames(
    simulator: Simulator,
    scenario: Scenario,
    episode: Episode,
    pattern: Pattern | PatternImage,
    frame_number: Int[np.ndarray, " f"],
) -> UInt8[np.ndarray, "f h w 3"]:
    """A drive's controls given again over the painted road: what the controller would have seen at some of its steps.

    Raises:
        RecordingError: the drive has fewer steps than are asked for.
    """
    wanted = set(frame_number.tolist())
    if not wanted or min(wanted) < 0 or max(wanted) >= len(episode):
        raise RecordingError(f"frames up to {max(wanted, default=0)} are asked of a drive of {len(episode)} steps")
    frames = look_again(simulator, episode, scenario, wanted, lambda seen: seen.frame, pattern=pattern)
    return np.stack(list(frames.values()))


def _rendered(
    scenario: Scenario,
    episode: Episode,
    frame_number: Int[np.ndarray, " f"],
    simulator: Simulator,
    paint: PatternImage,
) -> UInt8[np.ndarray, "f h w 3"]:
    return rendered_frames(simulator, scenario, episode, paint, frame_number)


def is_drive_of(recorded: Recording, episode: Episode) -> bool:
    """Whether a recording was taken on the drive of an episode: the same speeds at the same steps."""
    steps = recorded.frame_number
    inside = int(steps.max()) < len(episode)
    return inside and bool(np.allclose(episode.speed_mps[steps], recorded.speed_mps, atol=0.02))


def _covered(pattern: Pattern, recordings: RecordingSet, recorded: Recording) -> Bool[np.ndarray, "f h w"]:
    """Pixels of which the pattern covers at least half."""
    return covered_share(pattern, recorded.image_from_canvas, recordings.view, camera=recordings.camera) >= 0.5


def agreement(
    composited: UInt8[np.ndarray, "f h w 3"],
    rendered: UInt8[np.ndarray, "f h w 3"],
    paint: Bool[np.ndarray, "f h w"],
    *,
    clean_steer: Float[np.ndarray, " f"],
    composited_steer: Float[np.ndarray, " f"],
    rendered_steer: Float[np.ndarray, " f"],
) -> Agreement:
    """Compare composites with what a simulator rendered from the same places.

    Args:
        composited: recorded frames with the pattern composited in, (F, H, W, 3).
        rendered: the same frames as rendered over the real paint, (F, H, W, 3).
        paint: pixels that the pattern covers, (F, H, W).
        clean_steer: the controller's answers to the frames without paint, in steer units.
        composited_steer: controller's answers to the composited frames, in steer units, (F,).
        rendered_steer: controller's answers to the rendered frames, in steer units, (F,).

    Raises:
        EpisodeError: no pixel shows paint.
    """
    if not paint.any():
        raise EpisodeError("no frame shows any paint, so there is nothing to compare; check the pattern and the drive")
    error = np.abs(composited.astype(np.float32) - rendered).mean(-1)
    return Agreement(
        frames=len(composited),
        paint_error=float(error[paint].mean()),
        elsewhere_error=0.0 if paint.all() else float(error[~paint].mean()),
        steer_error=float(np.abs(composited_steer - rendered_steer).mean()),
        predicted_shift=float((composited_steer - clean_steer).mean()),
        rendered_shift=float((rendered_steer - clean_steer).mean()),
    )

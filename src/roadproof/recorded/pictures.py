"""What a car sees at any pose near the recorded ones: the nearest recorded frame, moved there, and painted.

The ground is a plane, so that between two poses it moves by a homography; what stands far off, above the horizon, by
that of a plane at infinity. They meet at the horizon, which is one row of the picture of a level camera. What the
nearest frame does not show, where the car has turned, comes from the nearest one that looked the same way. Gain, offset
and visibility of the paint move with the ground; the pattern is composited for the wanted pose itself, exactly. Behind
a lens pixels are straightened first (`geometry.sight`), and what W gives is bent again; the horizon is a curve then.

    symbol   meaning                                                              shape
    G        controller's input px from ground (x, y, 1), m from the canvas       (3, 3)
    T        ground from the car's own axes                                       (3, 3)
    W        source px from target px: G G'⁻¹ below the horizon, G' = G T T'⁻¹     (R, 3, 3)
    D        ∂(px without the lens, homogeneous)/∂(px), where there is a lens      (N, 3, 2)
"""

from __future__ import annotations

import copy
import math
from typing import NamedTuple, cast

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor
from torch.nn.functional import grid_sample

from roadproof.compositing.view import OwnViews, dilated, picked_pixels
from roadproof.coverage import Footprints, footprint_px, footprint_variance
from roadproof.errors import RecordingError
from roadproof.geometry import CANVAS_CORNERS_PX, CANVAS_SIZE_PX, CanvasPlacement, sight
from roadproof.photometry.responses import response_on
from roadproof.recorded.light import Light
from roadproof.recorded.nearest import LOOKING_THE_SAME_WAY, NEAREST, Apart, Gap, Poses, nearest, require_on_earth
from roadproof.recorded.packing import all_pixels, packed_pixels
from roadproof.recordings import RecordingSet

MISSED = 0.04
"""A frame is helped out by another where the picture reaches so far beyond it, in halves of its width or height."""

_IN_FRONT = 1e-6


class Moved(NamedTuple):
    """Recorded frames as they are seen from R other poses; float64.

    Args:
        frame: index of each frame, (R,).
        input_from_ground: G' of each pose, (R, 3, 3).
        ground_from_input: its inverse, (R, 3, 3).
        above: W above the horizon, (R, 3, 3).
        below: W below the horizon, (R, 3, 3).
    """

    frame: Int[Tensor, " r"]
    input_from_ground: Float[Tensor, "r 3 3"]
    ground_from_input: Float[Tensor, "r 3 3"]
    above: Float[Tensor, "r 3 3"]
    below: Float[Tensor, "r 3 3"]


class FrameBank:
    """All recorded frames of a set with their poses and the light on their canvas, ready to be looked up.

    Args:
        recordings: recordings whose canvas and tracks are known.
        device: torch device on which pictures are made.

    Raises:
        RecordingError: the set has no place of the canvas, or a drive has no poses.
    """

    def __init__(self, recordings: RecordingSet, *, device: torch.device | str = "cpu") -> None:
        canvas = recordings.canvas
        if canvas is None:
            raise RecordingError("the set does not say where its canvas lies; give RecordingSet a canvas")
        states: list[tuple[float, float, float]] = []
        for drive in recordings.recordings:
            if drive.track is None:
                raise RecordingError(f"drive {drive.name} has no track, so where its frames were taken is not known")
            rows = drive.track.rows(drive.frame_number)
            states += zip(
                (drive.track.x_m[rows] - canvas.x_m).tolist(),
                (drive.track.y_m[rows] - canvas.y_m).tolist(),
                drive.track.yaw_rad[rows].tolist(),
                strict=True,
            )
        self.camera, self.view, self.colour, self.canvas = recordings.camera, recordings.view, recordings.colour, canvas
        self.device = torch.device(device)
        self.poses = Poses(*self._exact(np.array(states)).T)
        levels = np.concatenate([drive.frames for drive in recordings.recordings])
        self.levels = torch.tensor(levels, device=self.device).permute(0, 3, 1, 2).float().contiguous()
        self.speed_mps = self._joined(recordings, "speed_mps", torch.float32)
        self.command = self._joined(recordings, "command", torch.int64)
        self._light = Light(recordings, self.device)
        self._response = response_on(self.colour.response, self.device, torch.float32)
        self._replayed = False
        self._set_rays()
        self.input_from_ground = self._recorded_views(recordings)
        self._input_from_car = self.input_from_ground @ self.poses.ground_from_car()

    def _exact(self, values: np.ndarray) -> Tensor:
        return torch.tensor(values, dtype=torch.float64, device=self.device)

    def _joined(self, recordings: RecordingSet, name: str, dtype: torch.dtype) -> Tensor:
        values = np.concatenate([getattr(drive, name) for drive in recordings.recordings])
        return torch.tensor(values, device=self.device, dtype=dtype)

    def _set_rays(self) -> None:
        """Set what depends on camera, crop and canvas alone."""
        camera, view = self.camera, self.view
        pitch = math.radians(camera.pitch_deg)
        # Seen right, up and ahead of the car, two cameras differ by a turn about the vertical alone.
        s, c = math.sin(pitch), math.cos(pitch)
        level_from_camera = np.array([[1.0, 0.0, 0.0], [0.0, -c, s], [0.0, s, c]])
        input_from_rays = view.input_from_camera @ camera.intrinsics
        self._level_from_input = self._exact(level_from_camera @ np.linalg.inv(input_from_rays))
        self._input_from_level = self._exact(input_from_rays @ level_from_camera.T)
        self._halves_from_px = self._exact(
            np.array(
                [
                    [2 / view.width_px, 0.0, 1 / view.width_px - 1],
                    [0.0, 2 / view.height_px, 1 / view.height_px - 1],
                    [0.0, 0.0, 1.0],
                ]
            )
        )
        self._set_horizon()
        through, bend = sight(view, camera)
        self._pixels, self._bend = self._exact(through).float(), self._exact(bend).float()
        first = self.horizon_row * view.width_px
        self._sky, self._ground = self._pixels[:, :first], self._pixels[:, first:]
        self._rays_from_input = self._exact(np.linalg.inv(input_from_rays))
        self._halves_from_rays = self._halves_from_px @ self._exact(input_from_rays)
        ground_from_canvas = _ground_from_canvas(self.canvas)
        self._corners = self._exact(ground_from_canvas @ CANVAS_CORNERS_PX.T)
        self._canvas_from_ground = self._exact(np.linalg.inv(ground_from_canvas))

    def _set_horizon(self) -> None:
        """Set which pixels look above the horizon: whole rows of them, or those of a curve behind a lens."""
        camera, view = self.camera, self.view
        if camera.lens is None:
            horizon = camera.focal_px * math.tan(math.radians(camera.pitch_deg)) + (camera.height_px - 1) / 2
            row = float((view.input_from_camera @ np.array([0.0, horizon, 1.0]))[1])
            self.horizon_row = min(max(math.ceil(row + 0.5), 0), view.height_px)
            return
        through, bend = sight(view, camera)
        upper_edge = self._exact(through - bend[:, :, 1].T / 2)
        self._is_sky = (self._level_from_input @ upper_edge)[1] > 0
        self.horizon_row = int(self._is_sky.view(-1, view.width_px).all(1).cumprod(0).sum())

    def _recorded_views(self, recordings: RecordingSet) -> Float[Tensor, "n 3 3"]:
        """G of every recorded frame, from its own homography, so that a camera that leans is where it was."""
        seen = np.concatenate([drive.image_from_canvas for drive in recordings.recordings])
        views = self._exact(recordings.view.input_from_camera @ seen) @ self._canvas_from_ground
        return views / views.square().sum((1, 2), keepdim=True).sqrt()

    def replayable(self) -> FrameBank:
        """The same frames, looked up by the same operations on tensors of the same shapes whatever the poses are.

        All pixels of the ground are painted, and nobody looks whether poses are out of all bounds, or NaN.
        """
        same = copy.copy(self)
        vars(same).update(_replayed=True)
        return same

    def nearest(self, poses: Poses, alike: Apart = NEAREST) -> Gap:
        """The recorded frame that shows most of what is seen from each pose.

        Raises:
            RecordingError: a pose is out of all bounds, or NaN.
        """
        if not self._replayed:
            require_on_earth(poses)
        return nearest(poses, self.poses, alike)

    def show(self, poses: Poses, gap: Gap, *, to_paint: bool = True) -> Views:
        """The bare pictures at some poses, and what is needed to paint them.

        Args:
            poses: the R poses, without a gradient.
            gap: the recorded frames for these poses, from `nearest`.
            to_paint: False leaves out what is needed to paint them, which takes nearly as long as the pictures.
        """
        moved = self._moved(poses, gap)
        return self._compiled(poses, moved, to_paint) if self._compiles else self._plain(poses, moved, to_paint)

    @property
    def _compiles(self) -> bool:
        """Whether kernels make these pictures."""
        return self.device.type == "cpu" and self.camera.lens is None and not self._replayed

    def _moved(self, poses: Poses, gap: Gap) -> Moved:
        """The recorded frames as they are seen from other poses."""
        # The car has moved on the ground as a whole: the camera looks at it as it did from the recorded pose.
        wanted = self._input_from_car[gap.frame] @ self._inverse(poses.ground_from_car())
        ground_from_input = self._inverse(wanted)
        below = self.input_from_ground[gap.frame] @ ground_from_input
        c, s, o = torch.cos(gap.turned_rad), torch.sin(gap.turned_rad), torch.zeros_like(gap.turned_rad)
        turn = torch.stack([c, o, -s, o, o + 1, o, s, o, c], -1).view(-1, 3, 3)
        above = self._input_from_level @ turn @ self._level_from_input
        return Moved(gap.frame, wanted, ground_from_input, above, below)

    def _compiled(self, poses: Poses, moved: Moved, to_paint: bool) -> Views:
        # Numba compiles when it is first called, and takes its time to be imported.
        from roadproof.recorded.compiled import draw, lit_canvas

        many, view = len(moved.frame), self.view
        drawn = torch.empty(many, 3, view.height_px, view.width_px)
        beyond = torch.full((many, view.height_px, view.width_px), torch.inf)
        source = self._halves(moved)
        draw(self.levels, moved.frame, source, self.horizon_row, torch.arange(many), drawn, beyond)
        missed = (beyond.flatten(1).amax(1) > MISSED).nonzero()[:, 0]
        if len(missed):
            other = self._moved(*self._looking_the_same_way(poses, missed))
            draw(self.levels, other.frame, self._halves(other), self.horizon_row, missed, drawn, beyond)
        frames = drawn.div_(255)
        rows = self._canvas_rows(moved.input_from_ground) if to_paint else None
        if rows is None:
            return Views(frames, None)
        canvas_from_input = self._canvas_from_ground @ moved.ground_from_input
        told = (moved.frame, source, self._light, footprint_variance(view), self._response)
        return Views(frames, lit_canvas(frames, rows, canvas_from_input, *told))

    def _plain(self, poses: Poses, moved: Moved, to_paint: bool) -> Views:
        source = self._seen_at(moved)
        frames, beyond = self._sampled(moved.frame, source)
        missing = beyond.flatten(1).amax(1) > MISSED
        missed = torch.arange(len(frames), device=self.device) if self._replayed else missing.nonzero()[:, 0]
        if len(missed):
            other = self._moved(*self._looking_the_same_way(poses, missed))
            second, further = self._sampled(other.frame, self._seen_at(other))
            first, short = frames.index_select(0, missed), beyond.index_select(0, missed)
            better = (short > 0) & (further < short) & missing[missed][:, None, None]
            frames = frames.index_copy_(0, missed, torch.where(better[:, None], second, first))
        return Views(frames, self._canvas_views(frames, moved, source) if to_paint else None)

    def _looking_the_same_way(self, poses: Poses, missed: Int[Tensor, " p"]) -> tuple[Poses, Gap]:
        """Some of the poses, and the frames that show what their nearest ones do not."""
        turned = poses.picked(missed)
        return turned, self.nearest(turned, LOOKING_THE_SAME_WAY)

    def _halves(self, moved: Moved) -> Float[Tensor, "r 2 3 3"]:
        """W above and below the horizon, to halves of the frame's size from its middle."""
        return self._halves_from_px @ torch.stack([moved.above, moved.below], 1)

    def _seen_at(self, moved: Moved) -> Float[Tensor, "r 2 n"]:
        """The place in its recorded frame that every pixel comes from, in halves of its size from its middle."""
        lens = self.camera.lens
        if lens is None:
            above, below = self._halves(moved).float().unbind(1)
            mapped = torch.cat([above @ self._sky, below @ self._ground], 2)
            # What is behind the camera would come out mirrored, in the sky; it is far outside the frame.
            return mapped[:, :2] / mapped[:, 2:].clamp_min_(_IN_FRONT)
        above, below = ((self._rays_from_input @ part).float() for part in (moved.above, moved.below))
        rays = torch.where(self._is_sky, above @ self._pixels, below @ self._pixels)
        scale, middle = self._halves_from_rays.diagonal()[:2].float(), self._halves_from_rays[:2, 2].float()
        shown = torch.stack(lens.distort(rays[:, 0], rays[:, 1], rays[:, 2], torch), 1)
        return shown * scale[:, None] + middle[:, None]

    def _sampled(self, frame: Int[Tensor, " r"], source: Float[Tensor, "r 2 n"]) -> tuple[Tensor, Tensor]:
        """Frames sampled at places, (R, 3, H, W), and how far each pixel lies beyond its frame, (R, H, W)."""
        height, width = self.view.height_px, self.view.width_px
        near = source.clamp(-3, 3)
        grid = near.mT.reshape(-1, height, width, 2)
        levels = self.levels.index_select(0, frame)
        shown = grid_sample(levels, grid, mode="bilinear", padding_mode="border", align_corners=False)
        return shown.round_().div_(255), near.abs_().amax(1).view(-1, height, width) - 1

    def _inverse(self, matrix: Float[Tensor, "r 3 3"]) -> Float[Tensor, "r 3 3"]:
        if not self._replayed:
            return cast("Tensor", torch.linalg.inv(matrix))
        # Torch asks the device whether there is an inverse.
        a, b, c = matrix.unbind(1)
        columns = torch.stack([torch.linalg.cross(b, c), torch.linalg.cross(c, a), torch.linalg.cross(a, b)], 2)
        return columns / (a * columns[:, :, 0]).sum(1)[:, None, None]

    def _canvas_views(
        self, frames: Float[Tensor, "r 3 h w"], moved: Moved, source: Float[Tensor, "r 2 n"]
    ) -> OwnViews | None:
        """The canvas' pixels of each picture with the light on them; None if no picture shows the canvas."""
        width = self.view.width_px
        rows = self._ground_rows if self._replayed else self._canvas_rows(moved.input_from_ground)
        if rows is None:
            return None
        canvas_from_input = (self._canvas_from_ground @ moved.ground_from_input).float()
        first = rows.start * width
        horizon = self.horizon_row * width
        mapped = canvas_from_input @ self._ground[:, first - horizon : rows.stop * width - horizon]
        depth = mapped[:, 2]
        ahead = depth > 0
        seen = mapped[:, :2] / depth[:, None]
        middle = (CANVAS_SIZE_PX - 1) / 2
        inside = ((seen - middle).abs_().amax(1) < CANVAS_SIZE_PX / 2) & ahead
        touches = dilated(inside.view(len(inside), -1, width), self._reach_px).flatten(1) & ahead
        packed = all_pixels(touches) if self._replayed else packed_pixels(touches)
        if packed is None:
            return None
        own, valid, real = packed
        at = torch.where(real[:, None], picked_pixels(seen, own), 1.0)
        scale = torch.where(real, depth.gather(1, own), 1.0)
        flat = own + first
        straight = self.camera.lens is None
        by = canvas_from_input[:, :, :2, None] if straight else canvas_from_input[..., None]
        jacobian = ((by[:, :2] - at[:, :, None] * by[:, 2:]) / scale[:, None, None]).permute(0, 3, 1, 2)
        jacobian = jacobian if straight else jacobian @ self._bend[flat]
        footprints = Footprints.made(at.mT[:, None], jacobian[:, None], footprint_variance(self.view))
        gain, offset, share = self._light.at(flat, picked_pixels(source, flat).mT, moved.frame, footprints)
        share = torch.where(real, share, 0.0)[..., None]
        light = (share * gain, share, offset)
        return OwnViews.lit(frames, flat, valid, footprints, light, self._response, dense=self._replayed)

    @property
    def _ground_rows(self) -> slice | None:
        """The rows that show the ground; None if none does."""
        return slice(self.horizon_row, self.view.height_px) if self.horizon_row < self.view.height_px else None

    @property
    def _reach_px(self) -> int:
        return footprint_px(footprint_variance(self.view))

    def _canvas_rows(self, input_from_ground: Float[Tensor, "r 3 3"]) -> slice | None:
        """The range of rows in which every picture has its canvas; None if no picture has one."""
        if self.camera.lens is not None:  # Its edges are curves, which corners do not bound.
            return self._ground_rows
        seen = input_from_ground @ self._corners
        ahead, row = seen[:, 2] > 0, seen[:, 1] / seen[:, 2]
        if not bool(ahead.any()):
            return None
        last = self.view.height_px
        top = float(torch.where(ahead, row, last).min())
        # What reaches behind the camera leaves the picture at its lower edge.
        bottom = float(torch.where(ahead, row, last).max())
        reach = self._reach_px
        first = min(max(math.floor(top) - reach, self.horizon_row), last)
        rows = (first, min(max(math.ceil(bottom) + 1 + reach, 0), last))
        return slice(*rows) if rows[0] < rows[1] else None


class Views(NamedTuple):
    """Pictures from R poses, ready to be painted.

    Args:
        frames: pictures of the bare road in [0, 1], (R, 3, H, W).
        canvas: the canvas' pixels of the pictures; None if no picture shows the canvas, or none is to be painted.
    """

    frames: Float[Tensor, "r 3 h w"]
    canvas: OwnViews | None


def _ground_from_canvas(canvas: CanvasPlacement) -> Float[np.ndarray, "3 3"]:
    """Ground (x, y, 1), in metres from the canvas' middle, from canvas px."""
    ground = canvas.world_from_canvas[[0, 1, 3]].copy()
    ground[:2, 2] -= (canvas.x_m, canvas.y_m)
    return ground

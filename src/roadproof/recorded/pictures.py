"""What a car sees at any pose near the recorded ones: the nearest recorded frame, moved there, and painted.

The ground is a plane, so that between two poses it moves by a homography; what stands far off, above the horizon, by
that of a plane at infinity. They meet at the horizon, which is one row of the picture of a level camera. Gain, offset
and visibility of the paint move with the ground; the pattern is composited for the wanted pose itself, exactly.

    symbol   meaning                                                              shape
    G        controller's input px from ground (x, y, 1), m from the canvas       (3, 3)
    T        ground from the car's own axes                                       (3, 3)
    W        source px from target px: G G'⁻¹ below the horizon, G' = G T T'⁻¹     (R, 3, 3)
"""

from __future__ import annotations

import math
from typing import NamedTuple, cast

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor
from torch.nn.functional import grid_sample, max_pool2d

from roadproof.compositing.view import OwnViews, canvas_pixels
from roadproof.coverage import Footprints, Shape, coverage
from roadproof.errors import RecordingError
from roadproof.geometry import CANVAS_SIZE_PX, CanvasPlacement, CropResize
from roadproof.recordings import RecordingSet

NEAR_M = (1.0, 0.5)
"""Gaps along and across the car's heading that count as much as `NEAR_RAD` of heading, when a frame is chosen."""
NEAR_RAD = 0.1


class Poses(NamedTuple):
    """Where R cars are on the ground, seen from the middle of the canvas; float64.

    Args:
        x_m: east of the canvas' middle, in the world's axes.
        y_m: north of it.
        yaw_rad: heading, left positive.
    """

    x_m: Float[Tensor, " r"]
    y_m: Float[Tensor, " r"]
    yaw_rad: Float[Tensor, " r"]

    def picked(self, index: Int[Tensor, " p"]) -> Poses:
        """Some of them."""
        return Poses(self.x_m[index], self.y_m[index], self.yaw_rad[index])

    def detached(self) -> Poses:
        """The same without a gradient."""
        return Poses(self.x_m.detach(), self.y_m.detach(), self.yaw_rad.detach())


class Gap(NamedTuple):
    """How far poses are from the recorded ones they are shown from.

    Args:
        frame: index of the recorded frame.
        ahead_m: along the heading, positive where the pose is further on.
        left_m: across it, positive where the pose is further left.
        turned_rad: of heading, left positive.
    """

    frame: Int[Tensor, " r"]
    ahead_m: Float[Tensor, " r"]
    left_m: Float[Tensor, " r"]
    turned_rad: Float[Tensor, " r"]


class FrameBank:
    """All recorded frames of a set with their poses and the light on their canvas, ready to be looked up.

    Args:
        recordings: a set whose canvas and tracks are known.
        device: where pictures are made.

    Raises:
        RecordingError: the canvas' place or the poses of a drive are not known.
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
        x, y, yaw = torch.tensor(states, dtype=torch.float64, device=self.device).T
        self.poses = Poses(x, y, yaw)
        levels = np.concatenate([drive.frames for drive in recordings.recordings])
        self.levels = torch.tensor(levels, device=self.device).permute(0, 3, 1, 2).float().contiguous()
        self.speed_mps = self._joined(recordings, "speed_mps", torch.float32)
        self.command = self._joined(recordings, "command", torch.int64)
        self.light = _light(recordings, self.device)
        self._set_rays()
        self.input_from_ground = self._recorded_views(recordings)

    def _joined(self, recordings: RecordingSet, name: str, dtype: torch.dtype) -> Tensor:
        values = np.concatenate([getattr(drive, name) for drive in recordings.recordings])
        return torch.tensor(values, device=self.device, dtype=dtype)

    def _set_rays(self) -> None:
        """What depends on camera and crop alone."""
        camera, view = self.camera, self.view
        lens = torch.tensor(view.input_from_camera @ camera.intrinsics, dtype=torch.float64, device=self.device)
        self._lens, self._rays = lens, _inverse(lens)
        pitch = math.radians(camera.pitch_deg)
        horizon = camera.focal_px * math.tan(pitch) + (camera.height_px - 1) / 2
        row = float((view.input_from_camera @ np.array([0.0, horizon, 1.0]))[1])
        self.horizon_row = min(max(math.ceil(row + 0.5), 0), view.height_px)
        columns, rows = torch.meshgrid(
            torch.arange(view.width_px, dtype=torch.float64),
            torch.arange(view.height_px, dtype=torch.float64),
            indexing="xy",
        )
        pixels = torch.stack([columns, rows, torch.ones_like(rows)]).flatten(1).to(self.device)
        first = self.horizon_row * view.width_px
        self._sky, self._ground = pixels[:, :first], pixels[:, first:]
        world = torch.tensor(_world_from_canvas(self.canvas), dtype=torch.float64, device=self.device)
        self._canvas_from_ground = _inverse(world)

    def _recorded_views(self, recordings: RecordingSet) -> Float[Tensor, "n 3 3"]:
        """G of every recorded frame: from its own homography, so that a camera that leans is where it was."""
        seen = np.concatenate([drive.image_from_canvas for drive in recordings.recordings])
        from_canvas = torch.tensor(recordings.view.input_from_camera @ seen, dtype=torch.float64, device=self.device)
        views = from_canvas @ self._canvas_from_ground
        return views / views.square().sum((1, 2), keepdim=True).sqrt()

    def nearest(self, poses: Poses) -> Gap:
        """The recorded frame that shows most of what is seen from each pose."""
        dx, dy = poses.x_m[:, None] - self.poses.x_m, poses.y_m[:, None] - self.poses.y_m
        c, s = torch.cos(poses.yaw_rad)[:, None], torch.sin(poses.yaw_rad)[:, None]
        ahead, left = c * dx + s * dy, c * dy - s * dx
        turned = torch.remainder(poses.yaw_rad[:, None] - self.poses.yaw_rad + math.pi, 2 * math.pi) - math.pi
        far = (ahead / NEAR_M[0]).square() + (left / NEAR_M[1]).square() + (turned / NEAR_RAD).square()
        index = far.argmin(1)
        at = index[:, None]
        return Gap(index, ahead.gather(1, at)[:, 0], left.gather(1, at)[:, 0], turned.gather(1, at)[:, 0])

    def show(self, poses: Poses, gap: Gap) -> Views:
        """The bare pictures at some poses, and what is needed to paint them.

        Args:
            poses: without a gradient.
            gap: from `nearest`.
        """
        view = self.view
        # The car has moved on the ground as a whole: the camera looks at it as it did from the recorded pose.
        source_view = self.input_from_ground[gap.frame]
        moved = _ground_from_car(self.poses.picked(gap.frame)) @ _inverse(_ground_from_car(poses))
        ground_from_input = _inverse(source_view @ moved)
        below = source_view @ ground_from_input
        c, s, o = torch.cos(gap.turned_rad), torch.sin(gap.turned_rad), torch.zeros_like(gap.turned_rad)
        # A ray of the target camera, in the axes of the source camera: both look down alike, so they differ by a turn
        # about the vertical, which camera axes see tilted.
        pitch = math.radians(self.camera.pitch_deg)
        sp, cp = math.sin(pitch), math.cos(pitch)
        tilt = c.new_tensor([[1.0, 0.0, 0.0], [0.0, -cp, sp], [0.0, sp, cp]]).T  # right, up, ahead from camera axes
        turn = torch.stack(
            [torch.stack([c, o, -s], -1), torch.stack([o, o + 1, o], -1), torch.stack([s, o, c], -1)], -2
        )
        above = self._lens @ tilt.T @ turn @ tilt @ self._rays
        mapped = torch.cat([above @ self._sky, below @ self._ground], 2)
        source = mapped[:, :2] / mapped[:, 2:]
        size = source.new_tensor([[view.width_px], [view.height_px]])
        grid = ((source + 0.5) / size * 2 - 1).clamp(-3, 3).float().mT.reshape(-1, view.height_px, view.width_px, 2)
        shown = grid_sample(self.levels[gap.frame], grid, mode="bilinear", padding_mode="border", align_corners=False)
        frames = shown.round_().div_(255)
        return Views(frames, self._canvas_views(frames, ground_from_input, source, gap))

    def _canvas_views(
        self, frames: Float[Tensor, "r 3 h w"], ground_from_input: Tensor, source: Float[Tensor, "r 2 n"], gap: Gap
    ) -> OwnViews | None:
        """The canvas' pixels of each picture with the light on them; None where none shows the canvas."""
        view = self.view
        canvas_from_input = (self._canvas_from_ground @ ground_from_input).float()
        first = self.horizon_row * view.width_px
        mapped = canvas_from_input @ self._ground.float()
        depth = mapped[:, 2]
        seen = mapped[:, :2] / depth[:, None]
        inside = ((seen > -0.5) & (seen < CANVAS_SIZE_PX - 0.5)).all(1) & (depth > 0)
        near = max_pool2d(inside.float().view(len(inside), 1, -1, view.width_px), 3, 1, 1).flatten(1) > 0
        touches = near & (depth > 0)
        counts = touches.sum(1)
        most = int(counts.max())
        if most == 0:
            return None
        _, pixel = touches.nonzero(as_tuple=True)
        # Rows are filled up with copies of their last pixel.
        start = counts.cumsum(0) - counts
        place = start[:, None] + torch.minimum(
            torch.arange(most, device=depth.device), (counts[:, None] - 1).clamp_min(0)
        )
        own = pixel[place.clamp_max(len(pixel) - 1)]
        valid = torch.arange(most, device=depth.device) < counts[:, None]
        inverse, (x, y) = canvas_from_input, seen.gather(2, own[:, None].expand(-1, 2, -1)).unbind(1)
        scale = depth.gather(1, own)
        # A picture without any canvas has no pixel to copy: what stands for it must only be finite.
        some = (counts > 0)[:, None]
        x, y, scale = (torch.where(some, part, 1.0) for part in (x, y, scale))
        slope = inverse[:, None, :2, :2] - torch.stack([x, y], -1)[..., None] * inverse[:, None, 2:, :2]
        jacobian = slope / scale[..., None, None]
        footprints = Footprints.made(torch.stack([x, y], -1)[:, None], jacobian[:, None], view.resampling)
        flat = own + first
        gain, offset, share = self._lit(source, flat, gap, footprints)
        share = torch.where(valid, share, 0.0)[..., None]
        clean = frames.flatten(2).gather(2, flat[:, None].expand(-1, 3, -1)).mT
        return OwnViews.of(flat, valid, footprints, clean, share * gain, share * (offset - clean), self.colour.response)

    def _lit(
        self, source: Float[Tensor, "r 2 n"], flat: Int[Tensor, "r p"], gap: Gap, footprints: Footprints
    ) -> tuple[Float[Tensor, "r p 3"], Float[Tensor, "r p 3"], Float[Tensor, "r p"]]:
        """Gain and offset of the canvas' pixels, and the share of each through which it is seen."""
        middle, size = (CANVAS_SIZE_PX - 1) / 2, float(CANVAS_SIZE_PX)
        whole = footprints.centre.new_tensor([middle, middle, size, size, 0.0])
        share = coverage(Shape.RECTANGLE, whole.expand(len(flat), 1, 5), footprints)[:, 0]
        if self.light is None:
            view = self.view
            row, column = torch.div(flat, view.width_px, rounding_mode="floor"), flat % view.width_px
            sx = (view.right_px - view.left_px) / view.width_px
            sy = (view.bottom_px - view.top_px) / view.height_px
            camera = torch.stack([(column + 0.5) * sx + view.left_px - 0.5, (row + 0.5) * sy + view.top_px - 0.5], -1)
            gain, offset = self.colour.gain_and_offset(camera.float())
            return gain, offset, share
        height, width = self.view.height_px, self.view.width_px
        x, y = source.gather(2, flat[:, None].expand(-1, 2, -1)).float().unbind(1)
        x, y = x.clamp(0, width - 1), y.clamp(0, height - 1)
        x0, y0 = x.floor().clamp_max(width - 2), y.floor().clamp_max(height - 2)
        fx, fy = (x - x0)[..., None], (y - y0)[..., None]
        corner = gap.frame[:, None] * (height * width) + (y0 * width + x0).long()
        upper = torch.lerp(self.light[corner], self.light[corner + 1], fx)
        lower = torch.lerp(self.light[corner + width], self.light[corner + width + 1], fx)
        light = torch.lerp(upper, lower, fy)
        return light[..., :3], light[..., 3:6], share * light[..., 6]


class Views(NamedTuple):
    """Pictures from R poses.

    Args:
        frames: of the bare road, in [0, 1].
        canvas: their canvas' pixels; None where none of them shows it.
    """

    frames: Float[Tensor, "r 3 h w"]
    canvas: OwnViews | None


def _inverse(matrix: Float[Tensor, "*b n n"]) -> Float[Tensor, "*b n n"]:
    return cast("Tensor", torch.linalg.inv(matrix))


def _ground_from_car(poses: Poses) -> Float[Tensor, "r 3 3"]:
    """The rigid motion from a car's own axes, ahead and left, to the ground."""
    c, s, o = torch.cos(poses.yaw_rad), torch.sin(poses.yaw_rad), torch.zeros_like(poses.yaw_rad)
    rows = [torch.stack([c, -s, poses.x_m], -1), torch.stack([s, c, poses.y_m], -1), torch.stack([o, o, o + 1], -1)]
    return torch.stack(rows, -2)


def _world_from_canvas(canvas: CanvasPlacement) -> Float[np.ndarray, "3 3"]:
    """Ground (x, y, 1), in metres from the canvas' middle, from canvas px."""
    ground = canvas.world_from_canvas[[0, 1, 3]].copy()
    ground[:2, 2] -= (canvas.x_m, canvas.y_m)
    return ground


def _light(recordings: RecordingSet, device: torch.device) -> Float[Tensor, "n 7"] | None:
    """Gain, offset and unoccluded share of every pixel of every frame; None where the set has one colour for all.

    Where the canvas is not seen, the mean of the frame stands: a moved picture looks a little beyond its edge.
    """
    maps = [drive.maps for drive in recordings.recordings]
    if any(each is None for each in maps):
        return None
    gain = torch.cat([each.gain for each in maps if each is not None])
    offset = torch.cat([each.offset for each in maps if each is not None])
    visible = torch.cat([each.visible for each in maps if each is not None])
    homographies = np.concatenate([drive.image_from_canvas for drive in recordings.recordings])
    expected = _expected_share(homographies, recordings.view)
    values = torch.cat([gain, offset], -1).float()
    known = (visible > 0.02)[..., None]
    mean = (values * known).sum((1, 2)) / known.sum((1, 2)).clamp_min(1)
    values = torch.where(known, values, mean[:, None, None])
    free = torch.where(expected > 0.05, visible / expected.clamp_min(0.05), 1.0).clamp(0.0, 1.0)
    return torch.cat([values, free[..., None]], -1).flatten(0, 2).to(device)


def _expected_share(homographies: Float[np.ndarray, "f 3 3"], view: CropResize) -> Float[Tensor, "f h w"]:
    """Share of every pixel that lies on the canvas, were nothing in its way."""
    index, centre, jacobian = canvas_pixels(homographies, view)
    footprints = Footprints.of(centre, jacobian, view.resampling)
    middle, size = (CANVAS_SIZE_PX - 1) / 2, float(CANVAS_SIZE_PX)
    share = torch.zeros(len(homographies) * view.height_px * view.width_px)
    share[torch.as_tensor(index)] = coverage(
        Shape.RECTANGLE, torch.tensor([middle, middle, size, size, 0.0]), footprints
    )
    return share.view(-1, view.height_px, view.width_px)

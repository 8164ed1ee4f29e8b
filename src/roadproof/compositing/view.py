"""What a set of recorded frames shows of the canvas: everything that does not depend on the pattern."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache

import numpy as np
import torch
from jaxtyping import Bool, Float, Int, UInt8
from torch import Tensor

from roadproof.coverage import (
    Footprints,
    Shape,
    axis_rows,
    canvas_share,
    footprint_px,
    footprint_variance,
    polygon_vertices,
)
from roadproof.errors import GeometryError
from roadproof.geometry import CANVAS_SIZE_PX, CameraModel, CropResize, sight
from roadproof.homographies import Homographies
from roadproof.patterns import Pattern
from roadproof.photometry import ColourTransform, PixelMaps, Response
from roadproof.photometry.responses import response_on


@dataclass(frozen=True, kw_only=True, slots=True, eq=False)
class CanvasPixels:
    """Picture pixels through which the canvas shows, with all that painting needs; * is nothing, or B pictures.

    Args:
        footprints: footprints on the canvas of these pixels.
        clean: clean colours of these pixels, (*, P, 3).
        gain: A = s·gain, (*, P, 3), with s the share of the pixel that lies on the canvas.
        bias: B = s·(offset − clean), (*, P, 3).
        response: response from painted to seen colour, before gain and bias.
        dense: whether every figure is painted in every pixel, by the same operations every time.
    """

    footprints: Footprints
    clean: Float[Tensor, "*b p 3"]
    gain: Float[Tensor, "*b p 3"]
    bias: Float[Tensor, "*b p 3"]
    response: Response
    dense: bool = False

    def figures(self, pattern: Pattern) -> Float[Tensor, "b k 12"]:
        """Twelve numbers of each figure of a pattern of one shape, for kernels; its leading dimensions are one.

        Of rectangles and ellipses they are c, s, o_u, o_v with u = c·x + s·y + o_u, v = c·y − s·x + o_v; c², c·s, s²;
        half their width and length. Of polygons, x and y of four corners, clockwise, the last one perhaps twice; and 0.
        Of all of them red, green, blue as seen are the last three.
        """
        (shape,), count = set(pattern.shapes), len(pattern.shapes)
        boxes, colours = pattern.boxes.reshape(-1, count, 5), pattern.colours.reshape(-1, count, 3)
        return torch.cat([_placed(shape, boxes), self.response(colours)], -1)


@dataclass(frozen=True, kw_only=True, slots=True, eq=False)
class CanvasView(CanvasPixels):
    """Recorded frames and the P pixels of theirs through which the canvas shows.

    Args:
        frames: clean frames in [0, 1], (F, H, W, 3).
        index: index of the P picture pixels that show the canvas in the flattened frames, (P,).
    """

    frames: Float[Tensor, "f h w 3"]
    index: Int[Tensor, " p"]

    @property
    def clean_frames(self) -> Float[Tensor, "f 3 h w"]:
        """The clean frames with channels first, as a controller takes them."""
        return self.frames.permute(0, 3, 1, 2)


@dataclass(frozen=True, kw_only=True, slots=True, eq=False)
class OwnViews(CanvasPixels):
    """Pictures of B poses and the P pixels of each through which the canvas shows: one picture for each pattern.

    Rows with fewer pixels are filled up with copies of their last one, which `valid` leaves out.

    Args:
        pixel: index of each pixel in its flattened picture, (B, P).
        valid: which pixels are not copies that fill up a row, (B, P).
    """

    pixel: Int[Tensor, "b p"]
    valid: Bool[Tensor, "b p"]

    @staticmethod
    def lit(
        frames: Float[Tensor, "b 3 h w"],
        pixel: Int[Tensor, "b p"],
        valid: Bool[Tensor, "b p"],
        footprints: Footprints,
        light: tuple[Float[Tensor, "b p #3"], Float[Tensor, "b p 1"], Float[Tensor, "b p 3"] | float],
        response: Response,
        *,
        dense: bool = False,
    ) -> OwnViews:
        """Pixels of pictures in a light.

        Args:
            frames: bare pictures in [0, 1].
            pixel: index of each pixel in its flattened picture.
            valid: which pixels are not copies that fill up a row.
            footprints: footprints of the pixels on the canvas.
            light: A = s·gain, the share s, and the offset.
            response: response from painted to seen colour.
            dense: whether every figure is painted in every pixel.
        """
        gain, share, offset = light
        clean = picked_pixels(frames.flatten(2), pixel).mT
        gain, bias = gain.expand_as(clean), share * (offset - clean)
        return OwnViews(
            pixel=pixel,
            valid=valid,
            footprints=footprints,
            clean=clean,
            gain=gain,
            bias=bias,
            response=response,
            dense=dense,
        )

    def pasted(self, frames: Float[Tensor, "b 3 h w"], colours: Float[Tensor, "b p 3"]) -> Float[Tensor, "b 3 h w"]:
        """The pictures with other colours in the canvas' pixels; the rest is copied bit for bit."""
        place = self.pixel[:, None].expand(-1, 3, -1)
        return frames.flatten(2).scatter(2, place, colours.mT).view_as(frames)


def _placed(shape: Shape, boxes: Float[Tensor, "*b 5"]) -> Float[Tensor, "*b 9"]:
    """The first nine numbers of figures of one shape."""
    if shape in (Shape.RECTANGLE, Shape.ELLIPSE):
        u, v, spread, _ = axis_rows(boxes).unbind(-2)
        return torch.cat([u[..., :3], v[..., 2:3], spread[..., 3:], boxes[..., 2:4] / 2], -1)
    corners = polygon_vertices(shape, boxes)
    last = corners[..., -1:, :].expand(*corners.shape[:-2], 4 - corners.shape[-2], 2)
    placed = torch.cat([corners, last], -2).flatten(-2)
    return torch.cat([placed, torch.zeros_like(placed[..., :1])], -1)


def fuses(values: Tensor) -> bool:
    """Whether `fused` paints rectangles on the device of these numbers, and in their precision."""
    return values.dtype == torch.float32 and compiles_kernels(values.device)


@cache
def compiles_kernels(device: torch.device) -> bool:
    """Whether a device is a GPU for which Triton is there and can compile."""
    if device.type != "cuda":
        return False
    try:
        from roadproof.compositing.fused import try_out

        try_out(device)
    except Exception:  # without Triton, its C compiler or a GPU it knows, all only takes longer
        return False
    return True


def picked_pixels(planes: Float[Tensor, "r c n"], index: Int[Tensor, "r p"]) -> Float[Tensor, "r c p"]:
    """The pixels of each picture at the given indices."""
    return planes.gather(2, index[:, None].expand(-1, planes.shape[1], -1))


def view_canvas(
    frames: UInt8[np.ndarray, "f h w 3"],
    image_from_canvas: Homographies,
    view: CropResize,
    colour: ColourTransform,
    *,
    camera: CameraModel | None = None,
    maps: PixelMaps | None = None,
    device: torch.device | str = "cpu",
    dtype: torch.dtype = torch.float32,
) -> CanvasView:
    """Prepare frames for compositing, by finding the pixels through which the canvas shows.

    Args:
        frames: clean frames at the controller's input, RGB, (F, H, W, 3).
        image_from_canvas: one homography per frame, canvas px to camera px.
        view: crop and resize that made the input from the camera picture.
        colour: colour transform from painted to seen.
        camera: camera of the frames, of which only the lens counts; None for a pinhole.
        maps: gain, offset and visibility of the canvas in every pixel, for the response of `colour`; they replace its
            smooth shading. None for that shading.
        device: torch device on which frames will be composited.
        dtype: precision of compositing, float32 by default; float64 for gradient checks.

    Raises:
        GeometryError: no frame shows the canvas.
    """
    index, centre, jacobian = canvas_pixels(image_from_canvas, view, camera)
    footprints = Footprints.of(centre, jacobian, footprint_variance(view), device=device, dtype=dtype)
    levels = torch.tensor(frames, device=device).to(dtype) / 255
    place = torch.as_tensor(index, device=device)
    clean = levels.reshape(-1, 3)[place]
    if maps is None:
        gain, offset = colour.gain_and_offset(camera_points(torch.as_tensor(index), view))
        share = canvas_share(footprints)
    else:
        own = torch.as_tensor(index)
        gain, offset, share = maps.gain.flatten(0, 2)[own], maps.offset.flatten(0, 2)[own], maps.visible.flatten()[own]
    gain, offset, share = (part.to(device=device, dtype=dtype) for part in (gain, offset, share[:, None]))
    gain, bias = share * gain, share * (offset - clean)
    return CanvasView(
        frames=levels,
        index=place,
        footprints=footprints,
        clean=clean,
        gain=gain,
        bias=bias,
        response=response_on(colour.response, device, dtype),
    )


def canvas_pixels(
    image_from_canvas: Homographies, view: CropResize, camera: CameraModel | None = None
) -> tuple[Int[np.ndarray, " p"], Float[np.ndarray, "p 2"], Float[np.ndarray, "p 2 2"]]:
    """Pixels of the controller's input whose footprint touches the canvas, in front of the camera.

    Args:
        image_from_canvas: one homography per frame, canvas px to camera px.
        view: crop and resize that make the input from the camera picture.
        camera: camera of the frames, of which only the lens counts; None for a pinhole.

    Returns:
        Index into the flattened (F, H, W) pixels (P,), canvas px of their centres (P, 2), and ∂canvas/∂pixel (P, 2, 2).

    Raises:
        GeometryError: no frame shows the canvas.
    """
    canvas_from_input = np.linalg.inv(view.input_from_camera @ image_from_canvas)
    through, bend = sight(view, camera)
    mapped = np.swapaxes(canvas_from_input @ through, 1, 2)
    # The inverse keeps the sign: its third coordinate, too, is positive in front of the camera.
    with np.errstate(divide="ignore", invalid="ignore"):
        centre = mapped[..., :2] / mapped[..., 2:]
        inside = (mapped[..., 2] > 0) & ((centre > -0.5) & (centre < CANVAS_SIZE_PX - 0.5)).all(-1)
    pictures = torch.from_numpy(inside.reshape(-1, view.height_px, view.width_px))
    touches = dilated(pictures, footprint_px(footprint_variance(view))).numpy().reshape(inside.shape)
    touches &= mapped[..., 2] > 0
    if not touches.any():
        raise GeometryError("no frame shows the canvas; check the homographies, or record nearer to it")
    frame, pixel = np.nonzero(touches)
    inverse, seen = canvas_from_input[frame], centre[frame, pixel]
    slope = (inverse[:, :2] - seen[:, :, None] * inverse[:, 2:]) @ bend[pixel]
    jacobian = slope / mapped[frame, pixel, 2][:, None, None]
    return frame * (view.height_px * view.width_px) + pixel, seen, jacobian


def dilated(mask: Bool[Tensor, "f h w"], count: int) -> Bool[Tensor, "f h w"]:
    """A mask grown by so many pixels to every side."""
    for _ in range(count):
        wide = mask.clone()
        wide[:, :, 1:] |= mask[:, :, :-1]
        wide[:, :, :-1] |= mask[:, :, 1:]
        mask = wide.clone()
        mask[:, 1:] |= wide[:, :-1]
        mask[:, :-1] |= wide[:, 1:]
    return mask


def camera_points(index: Int[Tensor, "*n"], view: CropResize) -> Float[Tensor, "*n 2"]:
    """Camera coordinates of the pixels at an index into flattened frames; float64."""
    pixel = index % (view.height_px * view.width_px)
    row, column = torch.div(pixel, view.width_px, rounding_mode="floor"), pixel % view.width_px
    camera_from_input = torch.tensor(np.linalg.inv(view.input_from_camera), device=index.device)
    return torch.stack([column, row], -1) * camera_from_input.diagonal()[:2] + camera_from_input[:2, 2]

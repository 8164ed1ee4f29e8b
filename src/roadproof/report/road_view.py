"""Roads, canvases and patterns from above, drawn to scale on the axes of a plot."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, UInt8
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.collections import LineCollection, PolyCollection
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle
from matplotlib.transforms import Affine2D
from PIL import Image

from roadproof.errors import ScenarioError
from roadproof.geometry import CanvasPlacement
from roadproof.roads.maps import load_map
from roadproof.roads.roadmap import SURFACE_OF_KIND, RoadMap, Surface
from roadproof.simulators.protocol import PatternImage

ASPHALT = (92, 94, 98)
DPI = 100
MOST_TIMES_AS_LONG = 100
"""The picture of a canvas is no longer than so many of its widths, or it might fill all memory."""

Points = Float[np.ndarray, "n 2"]
Box = tuple[float, float, float, float]
"""Left, low, right and high edge of what is shown, in metres."""


@dataclass(frozen=True, slots=True)
class Ground:
    """The colours of a road, as matplotlib names them.

    Args:
        sidewalk: the sidewalks.
        asphalt: the lanes, and the shoulders where these have no colour of their own.
        marking: the painted lines, and the yellow ones where these have no colour of their own.
        shoulder: the shoulders.
        yellow: the lines that are yellow.
        grass: what lies beside the road.
    """

    sidewalk: str
    asphalt: str
    marking: str
    shoulder: str | None = None
    yellow: str | None = None
    grass: str = "none"


DAYLIGHT = Ground("#d8d2c6", "#6f7175", "#f4f4f4", shoulder="#9a9a96", yellow="#f2c230", grass="#e9eddf")


def plan_of(box: Box, size_in: tuple[float, float], ground: str) -> tuple[Figure, Axes]:
    """A new figure, and the axes in metres that fill it.

    Args:
        box: left, low, right and high edge of what is shown, in metres.
        size_in: width and height of the figure, in inches.
        ground: the colour below everything.
    """
    left, low, right, high = box
    figure = Figure(figsize=size_in, dpi=DPI, facecolor=ground)
    axes = figure.add_axes((0.0, 0.0, 1.0, 1.0))
    axes.set(xlim=(left, right), ylim=(low, high), aspect="equal")
    axes.set_axis_off()
    return figure, axes


def around_canvas(canvas: CanvasPlacement) -> Callable[[Points], Points]:
    """The function from world x, y to metres right of and ahead of the canvas' middle."""
    c, s = math.cos(canvas.yaw_rad), math.sin(canvas.yaw_rad)

    def around(points: Points) -> Points:
        dx, dy = points[:, 0] - canvas.x_m, points[:, 1] - canvas.y_m
        return np.column_stack([s * dx - c * dy, c * dx + s * dy])

    return around


def in_world(points: Points) -> Points:
    """World x, y as they are: a map with north up."""
    return points


def road_of(map_name: str) -> RoadMap | None:
    """A scenario's map; None for another simulator's, without which paths and canvas are shown."""
    try:
        return load_map(map_name)
    except ScenarioError:
        return None


def draw_road(axes: Axes, road: RoadMap, around: Callable[[Points], Points], box: Box, ground: Ground) -> None:
    """Draw what of a map lies in a box.

    Args:
        axes: the axes to draw on.
        road: the map that is drawn.
        around: the function from world x, y to the plane of the axes (`around_canvas`, `in_world`).
        box: left, low, right and high edge of what is drawn, in metres of that plane.
        ground: the colours of the road.
    """
    left, low, right, high = box
    beside = ground.shoulder or ground.asphalt
    colours = {Surface.SIDEWALK: ground.sidewalk, Surface.SHOULDER: beside, Surface.DRIVING: ground.asphalt}

    def inside(points: Points) -> bool:
        outside = (points.max(0) < (left, low)) | (points.min(0) > (right, high))
        return not bool(outside.any())

    for surface, colour in colours.items():
        lanes = [lane for lane in road.lanes if SURFACE_OF_KIND.get(lane.kind) is surface]
        outlines = [np.concatenate([lane.left, lane.right[::-1]])[:, :2] for lane in lanes]
        if surface is Surface.DRIVING:
            outlines += [area.outline[:, :2] for area in road.junctions]
        shapes = [plan for plan in map(around, outlines) if inside(plan)]
        axes.add_collection(PolyCollection(shapes, facecolors=colour, edgecolors=colour, linewidths=0.4))
    lines = [(around(line.points[:, :2]), line.mark) for line in road.mark_lines if line.junction is None]
    kept = [(plan, mark) for plan, mark in lines if inside(plan)]
    axes.add_collection(
        LineCollection(
            [plan for plan, _ in kept],
            colors=[ground.yellow or ground.marking if mark.colour == "yellow" else ground.marking for _, mark in kept],
            linewidths=0.8,
            zorder=1.2,  # below what is painted on a canvas
            linestyles=["--" if mark.kind == "broken" else "-" for _, mark in kept],
        )
    )


def draw_canvas(axes: Axes, canvas: CanvasPlacement, paint: PatternImage | None, ink: str, *, upright: bool) -> None:
    """Draw the outline of a canvas, and the pattern on it.

    Args:
        axes: the axes to draw on, in metres.
        canvas: the canvas that is drawn, as it lies in the world.
        paint: the pattern; None for a bare canvas.
        ink: the colour of the outline.
        upright: whether the axes are the canvas' own (`around_canvas`), else they are the world's.
    """
    width, length = canvas.width_m, canvas.length_m
    turned = Affine2D()
    if not upright:
        turned = turned.rotate(canvas.yaw_rad - math.pi / 2).translate(canvas.x_m, canvas.y_m)
    placed, limits = turned + axes.transData, (axes.get_xlim(), axes.get_ylim())
    if paint is not None:
        extent = (-width / 2, width / 2, -length / 2, length / 2)
        axes.imshow(paint, extent=extent, interpolation="antialiased", zorder=1.5, transform=placed)
    outline = Rectangle((-width / 2, -length / 2), width, length, fill=False, edgecolor=ink, linewidth=0.8)
    outline.set(linestyle=(0, (3, 2)), transform=placed)
    axes.add_patch(outline)
    axes.set(xlim=limits[0], ylim=limits[1], aspect="equal")


def pixels_of(figure: Figure) -> UInt8[np.ndarray, "h w 3"]:
    """A figure as pixels."""
    drawn = FigureCanvasAgg(figure)
    drawn.draw()
    return np.asarray(drawn.buffer_rgba())[..., :3]


def on_asphalt(paint: UInt8[np.ndarray, "s s 4"], width_px: int, canvas: CanvasPlacement | None) -> Image.Image:
    """A pattern on asphalt in its true proportions, within reason, direction of travel upwards.

    Args:
        paint: the pattern on the canvas, RGBA.
        width_px: the width of the picture, in pixels.
        canvas: the canvas whose proportions it has; None for a square.
    """
    road = Image.new("RGB", (paint.shape[1], paint.shape[0]), ASPHALT)
    road.paste(Image.fromarray(paint[..., :3]), (0, 0), Image.fromarray(paint[..., 3]))
    width, length = (1.0, 1.0) if canvas is None else (canvas.width_m, canvas.length_m)
    height_px = round(width_px * min(length / width, MOST_TIMES_AS_LONG))
    return road.resize((width_px, max(height_px, 1)), Image.Resampling.LANCZOS)

"""The canvas in the scene."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from jaxtyping import Float, UInt8

from roadproof.datatypes import VehicleState
from roadproof.geometry import CANVAS_SIZE_PX, CameraModel, CanvasPlacement, CropResize
from roadproof.simulators.town.canvas import COARSEST, NEAREST_M, PATCH_PX, Raster, RoadPatch, copies, reductions_for
from roadproof.simulators.town.engine import (
    VERTEX,
    Graphics,
    Path,
    Texture,
    fill_texture,
    make_node,
    make_texture,
    refill_node,
)
from roadproof.simulators.town.shading import Layer, dress

PIECE_CORNERS = 12
CORNERS = np.array([(x, y, 1.0) for x in (-0.5, CANVAS_SIZE_PX - 0.5) for y in (-0.5, CANVAS_SIZE_PX - 0.5)])
LINEAR_SHIFT = {Graphics.SOFTWARE: 0.5, Graphics.EGL: 0.0}
"""By how many texels a texture is moved: software interpolates between the texel hit and the one before it."""


class CanvasNode:
    """The patch of road with the pattern: as many nodes as there are copies, each drawn where its copy suits."""

    def __init__(
        self, root: Path, camera: CameraModel, crops: tuple[tuple[CropResize, int], ...], graphics: Graphics
    ) -> None:
        self._root = root.attach_new_node("canvas")
        self._camera, self._crops, self._shift = camera, crops, LINEAR_SHIFT[graphics]
        self._placement: CanvasPlacement | None = None
        self._patch: RoadPatch | None = None
        self._rasters: list[Raster] = []
        self._reductions: list[tuple[int, int]] = []
        self._textures: list[Texture] = []
        self._world_from_canvas: Float[np.ndarray, "4 3"] = np.zeros((4, 3))
        self._shown = [False] * (COARSEST + 1)
        fan = np.array([[0, i, i + 1] for i in range(1, PIECE_CORNERS - 1)])
        self._fans = [make_node("canvas", np.zeros(PIECE_CORNERS, VERTEX), fan) for _ in range(COARSEST + 1)]
        self._paths = [self._root.attach_new_node(node) for node in self._fans]
        for path in self._paths:
            dress(path, Layer.CANVAS)
            path.hide()

    def forget(self) -> None:
        """Forget what was baked, since the light has changed."""
        self._placement = None

    def lay(self, placement: CanvasPlacement, bake: Callable[[], RoadPatch]) -> None:
        """Choose the place; `bake` makes the road there."""
        if placement == self._placement:
            return
        self._placement, self._patch = placement, bake()
        self._world_from_canvas = placement.world_from_canvas
        crop, magnified = self._crops[0]
        across, down = crop.input_from_camera[0, 0] * magnified, crop.input_from_camera[1, 1] * magnified
        focal = self._camera.focal_px
        self._reductions = reductions_for(placement, self._camera, (focal * across, focal * down))
        blank = np.zeros((PATCH_PX, PATCH_PX, 3), np.uint8)
        self._textures = [make_texture(copy, mipmaps=False, smooth=True) for copy in copies(blank, self._reductions)]
        for path, texture in zip(self._paths, self._textures, strict=True):
            path.set_texture(texture)
        texel = placement.length_m / PATCH_PX
        self._rasters = [
            Raster.of(self._camera, crop, magnified, texel, len(self._reductions)) for crop, magnified in self._crops
        ]

    def paint(self, pattern: UInt8[np.ndarray, "400 400 4"] | None) -> None:
        """Mix a pattern with the road."""
        assert self._patch is not None
        made = copies(self._patch.painted(pattern), self._reductions)
        for texture, copy in zip(self._textures, made, strict=True):
            fill_texture(texture, copy)

    def close(self) -> None:
        """Take the canvas out of the world."""
        self._root.remove_node()

    def hide(self) -> None:
        """Hide the canvas until the next `see`."""
        self._shown = [False] * len(self._paths)
        for path in self._paths:
            path.hide()

    def see(self, state: VehicleState, which: int) -> None:
        """Shape the canvas for one view from one screen."""
        if self._placement is None:
            return
        outlines: dict[int, Float[np.ndarray, "n 2"]] = {}
        homography = self._camera.image_from_world(state) @ self._world_from_canvas
        if (CORNERS @ homography[2]).max() > NEAREST_M:
            outlines = {piece.copy: piece.outline for piece in self._rasters[which].pieces(homography)}
        for k, (path, shown) in enumerate(zip(self._paths, self._shown, strict=True)):
            if k in outlines:
                refill_node(self._fans[k], self._vertices(k, outlines[k]))
            if shown != (k in outlines):
                self._shown[k] = not shown
                (path.hide if shown else path.show)()

    def _vertices(self, copy: int, outline: Float[np.ndarray, "n 2"]) -> np.ndarray:
        """A fan of fixed size: the last corner is repeated."""
        corners = outline[np.minimum(np.arange(PIECE_CORNERS), len(outline) - 1)]
        vertices = np.zeros(PIECE_CORNERS, VERTEX)
        homogeneous = np.column_stack([corners, np.ones(PIECE_CORNERS)])
        vertices["position"] = (homogeneous @ self._world_from_canvas.T)[:, :3]
        across, along = self._reductions[copy]
        texel = np.array([2**across, 2**along]) / PATCH_PX
        vertices["uv"] = (corners + 0.5) / CANVAS_SIZE_PX * (1, -1) + (0, 1) + self._shift * texel
        vertices["colour"] = 255
        return vertices

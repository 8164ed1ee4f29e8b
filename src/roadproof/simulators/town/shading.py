"""How meshes are drawn: in which order, in what light, and the nodes that carry their vertex colours."""

from __future__ import annotations

from dataclasses import replace
from enum import IntEnum

import numpy as np
from jaxtyping import Float, UInt8

from roadproof.simulators.town.engine import VERTEX, Node, Path, core, make_node
from roadproof.simulators.town.meshes import Mesh, Pose
from roadproof.simulators.town.weather import Sky


class Layer(IntEnum):
    """Order of drawing; up to the pavement nothing is tested for depth."""

    GROUND = 1
    PAINT = 2
    CANVAS = 3
    SHADE = 4
    PAVEMENT = 5
    PAVEMENT_SHADE = 6
    SOLID = 10
    SMALL = 11
    CUT_OUT = 20
    FAR_LAND = 21
    HAZE = 22
    SKY = 23
    RAIN = 30


def dress(path: Path, layer: Layer) -> None:
    """Set how a node is drawn from its layer."""
    path.set_bin("fixed", int(layer))
    if layer in (Layer.GROUND, Layer.PAINT, Layer.CANVAS, Layer.SHADE, Layer.PAVEMENT_SHADE, Layer.RAIN):
        path.set_depth_test(False)
        path.set_depth_write(layer is Layer.GROUND)
    if layer in (Layer.SHADE, Layer.PAVEMENT_SHADE, Layer.HAZE, Layer.RAIN):
        path.set_transparency(core.TransparencyAttrib.M_alpha)
        path.set_depth_write(False)
    if layer is Layer.CUT_OUT:
        path.set_transparency(core.TransparencyAttrib.M_binary)
    if layer in (Layer.CUT_OUT, Layer.SKY, Layer.HAZE, Layer.RAIN):
        path.set_two_sided(True)


def shaded(mesh: Mesh, sky: Sky, sunlit: Float[np.ndarray, " n"]) -> UInt8[np.ndarray, "n 4"]:
    """Vertex colours of what stands in the open: walls see half of the sky."""
    facing = np.clip(mesh.normals @ sky.to_sun, 0, None)
    open_sky = 0.78 + 0.22 * np.clip(mesh.normals[:, 2], -1, 1)
    return rgba(mesh.albedo * sky.light(facing, sunlit, open_sky) * (1 - 0.10 * sky.wetness))


def turned(mesh: Mesh, yaw_rad: float) -> Mesh:
    """The mesh with its normals turned, for light."""
    normals = mesh.normals @ Pose(0.0, 0.0, yaw_rad).rotation.T
    return replace(mesh, normals=normals.round(4))


def rgba(colour: Float[np.ndarray, "n 3"], alpha: float = 1.0) -> UInt8[np.ndarray, "n 4"]:
    """Bytes of a colour in [0, 1]."""
    levels = np.column_stack([colour, np.full(len(colour), alpha)])
    return (np.clip(levels, 0, 1) * 255 + 0.5).astype(np.uint8)


def mesh_node(
    mesh: Mesh, colours: UInt8[np.ndarray, "n 4"] | int = 255, ground_uv: Float[np.ndarray, "n 2"] | None = None
) -> Node:
    """A node of a mesh with its vertex colours, white if none, and, on the ground, its place in the picture."""
    vertices = np.zeros(len(mesh.points), VERTEX)
    vertices["position"], vertices["uv"], vertices["colour"] = mesh.points, mesh.uv, colours
    if ground_uv is not None:
        vertices["ground_uv"] = ground_uv.round(5)
    return make_node("mesh", vertices, mesh.triangles)

"""Meshes under the light of a weather: vertex colours, and nodes that carry them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from jaxtyping import Float, UInt8

from roadproof.simulators.town.engine import VERTEX, Node, make_node
from roadproof.simulators.town.meshes import Mesh, Pose
from roadproof.simulators.town.weather import Sky


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


def mesh_node(mesh: Mesh, colours: UInt8[np.ndarray, "n 4"], ground_uv: Float[np.ndarray, "n 2"] | None = None) -> Node:
    """A node of a mesh with its vertex colours and, on the ground, its place in the picture of the ground."""
    vertices = np.zeros(len(mesh.points), VERTEX)
    vertices["position"], vertices["uv"], vertices["colour"] = mesh.points, mesh.uv, colours
    if ground_uv is not None:
        vertices["ground_uv"] = ground_uv.round(5)
    return make_node("mesh", vertices, mesh.triangles)

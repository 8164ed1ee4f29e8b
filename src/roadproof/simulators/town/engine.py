"""Panda3D's renderers, kept behind a few verbs: make a screen, make a texture, make a mesh, read a picture.

One screen is one process-private buffer with its own lens. Nothing here knows about roads.
"""

from __future__ import annotations

import importlib
import math
from enum import StrEnum
from typing import Any, TypeAlias

import numpy as np
from jaxtyping import Int, UInt8
from PIL import Image

from roadproof.datatypes import VehicleState
from roadproof.errors import SimulatorError
from roadproof.geometry import CameraModel, CropResize

try:
    # Panda3D ships no type information.
    core: Any = importlib.import_module("panda3d.core")
    bullet: Any = importlib.import_module("panda3d.bullet")
except ImportError as error:  # pragma: no cover - the extra is installed where this is tested
    raise SimulatorError("the town needs Panda3D, which is not installed: pip install 'roadproof[town]'") from error

CONFIGURATION = """
load-display p3tinydisplay
aux-display p3tinydisplay
window-type offscreen
audio-library-name null
textures-power-2 down
support-threads 0
texture-quality-level normal
notify-level-display fatal
garbage-collect-states 0
"""

# Panda3D's objects, by what they stand for.
Pipe: TypeAlias = Any
Path: TypeAlias = Any
Node: TypeAlias = Any
Texture: TypeAlias = Any
VertexFormat: TypeAlias = Any
Stage: TypeAlias = Any

NEAR_M, FAR_M = 0.25, 100_000.0

VERTEX = np.dtype([("position", "<f4", 3), ("uv", "<f4", 2), ("ground_uv", "<f4", 2), ("colour", "u1", 4)])
"""One vertex: metres, texture coordinates, coordinates in the ground texture of its cell, RGBA."""


class Graphics(StrEnum):
    """What draws."""

    SOFTWARE = "software"
    """Panda3D's own renderer, on one CPU core; the same pixels everywhere."""

    EGL = "egl"
    """OpenGL without a screen: on the GPU where there is one, else by Mesa on the CPU."""


_RENDERERS = {
    Graphics.SOFTWARE: ("TinyOffscreenGraphicsPipe", "p3tinydisplay", "libX11.so.6", "libx11-6"),
    Graphics.EGL: ("eglGraphicsPipe", "p3headlessgl", "libEGL.so.1 and a driver", "libegl1 libgl1-mesa-dri"),
}
"""Panda3D's pipe and its module, what this needs of the system, and the packages that have it."""


_pipes: dict[Graphics, Pipe] = {}


def make_pipe(graphics: Graphics = Graphics.SOFTWARE) -> Pipe:
    """The pipe of a renderer, the same for the whole process.

    Raises:
        SimulatorError: the renderer cannot be loaded, which means that a library of the system is missing.
    """
    if not _pipes:
        # Panda3D's configuration is the whole process's.
        core.load_prc_file_data("roadproof", CONFIGURATION)
    if graphics not in _pipes:
        name, module, needed, packages = _RENDERERS[graphics]
        pipe = core.GraphicsPipeSelection.get_global_ptr().make_pipe(name, module)
        if pipe is None:
            raise SimulatorError(
                f"Panda3D's {graphics} renderer did not load: it needs the system library {needed}; "
                f"install it (Debian and Ubuntu: apt-get install {packages})"
            )
        # Whichever pipe of EGL's goes first ends the display of all.
        _pipes[graphics] = pipe
    return _pipes[graphics]


def vertex_format() -> VertexFormat:
    """Panda3D's description of `VERTEX`."""
    array = core.GeomVertexArrayFormat()
    array.add_column("vertex", 3, core.Geom.NT_float32, core.Geom.C_point)
    array.add_column("texcoord", 2, core.Geom.NT_float32, core.Geom.C_texcoord)
    array.add_column(core.InternalName.get_texcoord_name("ground"), 2, core.Geom.NT_float32, core.Geom.C_texcoord)
    array.add_column("color", 4, core.Geom.NT_uint8, core.Geom.C_color)
    whole = core.GeomVertexFormat()
    whole.add_array(array)
    return core.GeomVertexFormat.register_format(whole)


def ground_stage() -> Stage:
    """The second texture of a mesh: the baked colour of the ground, multiplied with the grain of the first."""
    stage = core.TextureStage("ground")
    stage.set_texcoord_name("ground")
    stage.set_sort(1)
    return stage


def make_node(name: str, vertices: np.ndarray, triangles: Int[np.ndarray, "t 3"]) -> Node:
    """A mesh node from an array of `VERTEX` and vertex indices, counter-clockwise seen from outside."""
    data = core.GeomVertexData(name, vertex_format(), core.Geom.UH_static)
    data.unclean_set_num_rows(len(vertices))
    memoryview(data.modify_array(0)).cast("B")[:] = vertices.tobytes()
    primitive = core.GeomTriangles(core.Geom.UH_static)
    wide = len(vertices) > 65_000
    primitive.set_index_type(core.Geom.NT_uint32 if wide else core.Geom.NT_uint16)
    indices = primitive.modify_vertices()
    indices.unclean_set_num_rows(triangles.size)
    memoryview(indices).cast("B")[:] = triangles.astype(np.uint32 if wide else np.uint16).tobytes()
    mesh = core.Geom(data)
    mesh.add_primitive(primitive)
    node = core.GeomNode(name)
    node.add_geom(mesh)
    return node


def refill_node(node: Node, vertices: np.ndarray) -> None:
    """Replace the vertices of a mesh node by as many others."""
    array = node.modify_geom(0).modify_vertex_data().modify_array(0)
    memoryview(array).cast("B")[:] = vertices.tobytes()
    # What is out of sight is not drawn: the bounds must follow.
    node.modify_geom(0).mark_bounds_stale()
    node.mark_internal_bounds_stale()


def make_texture(
    rgba: UInt8[np.ndarray, "h w c"], *, repeat: bool = False, mipmaps: bool = True, smooth: bool = False
) -> Texture:
    """A texture whose first row is the upper edge (v = 1).

    Args:
        rgba: pixels of three or four channels; the sides are powers of two.
        repeat: whether to tile the texture; otherwise its edge goes on for ever.
        mipmaps: whether to choose a coarser copy in the distance.
        smooth: whether to interpolate between texels everywhere, at about six times the cost per pixel.
    """
    texture = core.Texture()
    height, width, channels = rgba.shape
    kind = core.Texture.F_rgba if channels == 4 else core.Texture.F_rgb
    texture.setup_2d_texture(width, height, core.Texture.T_unsigned_byte, kind)
    wrap = core.SamplerState.WM_repeat if repeat else core.SamplerState.WM_clamp
    texture.set_wrap_u(wrap)
    texture.set_wrap_v(wrap)
    linear = core.SamplerState.FT_linear
    texture.set_minfilter(core.SamplerState.FT_linear_mipmap_nearest if mipmaps else linear)
    texture.set_magfilter(linear)
    if smooth:
        texture.set_quality_level(core.Texture.QL_best)
    fill_texture(texture, rgba)
    return texture


def fill_texture(texture: Texture, rgba: UInt8[np.ndarray, "h w c"]) -> None:
    """Repaint a texture of the same size."""
    order = [2, 1, 0, 3][: rgba.shape[2]]
    texture.set_ram_image(np.ascontiguousarray(rgba[::-1, :, order]).tobytes())


class Screen:
    """An offscreen buffer that sees the crop of a camera, magnified by a whole number and reduced again by a box.

    Args:
        pipe: the renderer's pipe (`make_pipe`).
        root: the node of the world that is shown.
        camera: the pinhole camera that sees the world.
        crop: the part of the camera's picture that is seen, and the size of what comes out.
        magnified: pixels rendered per pixel that comes out, along each side.
        anywhere: whether the camera may be so high that sky and ground leave pixels free; these are black.

    Attributes:
        camera: the pinhole camera; may be replaced by one of the same size and field of view that looks from elsewhere.
    """

    def __init__(
        self,
        pipe: Pipe,
        root: Path,
        camera: CameraModel,
        crop: CropResize,
        magnified: int,
        *,
        anywhere: bool = False,
    ) -> None:
        self.camera, self._magnified = camera, magnified
        self._size = (crop.width_px * magnified, crop.height_px * magnified)
        self._engine = core.GraphicsEngine.get_global_ptr()
        properties = core.FrameBufferProperties()
        properties.set_rgb_color(True)
        properties.set_rgba_bits(8, 8, 8, 8)
        properties.set_depth_bits(24)
        size = core.WindowProperties.size(*self._size)
        flags = core.GraphicsPipe.BF_refuse_window | core.GraphicsPipe.BF_resizeable
        self._buffer = self._engine.make_output(pipe, "screen", 0, properties, size, flags)
        if self._buffer is None:
            raise SimulatorError(f"Panda3D gave no offscreen buffer of {self._size[0]}×{self._size[1]} pixels")
        lens = core.PerspectiveLens()
        lens.set_film_size(crop.right_px - crop.left_px, crop.bottom_px - crop.top_px)
        lens.set_focal_length(camera.focal_px)
        lens.set_film_offset(
            (crop.left_px + crop.right_px - camera.width_px) / 2, (camera.height_px - crop.top_px - crop.bottom_px) / 2
        )
        lens.set_near_far(NEAR_M, FAR_M)
        self._eye = root.attach_new_node(core.Camera("eye", lens))
        region = self._buffer.make_display_region()
        region.set_camera(self._eye)
        region.set_clear_depth_active(True)
        # Where the sky covers every pixel no colour need be cleared.
        self._buffer.set_clear_color_active(anywhere)
        self._buffer.set_clear_color(core.Vec4(0, 0, 0, 0))
        self._pixels = core.Texture()
        self._buffer.add_render_texture(self._pixels, core.GraphicsOutput.RTM_copy_ram)
        self._buffer.set_active(False)

    def look_from(self, state: VehicleState) -> tuple[float, float, float]:
        """Put the eye where the camera of a vehicle is; returns its world position in metres."""
        camera, yaw = self.camera, state.yaw_rad
        x = state.x_m + camera.forward_m * math.cos(yaw) - camera.left_m * math.sin(yaw)
        y = state.y_m + camera.forward_m * math.sin(yaw) + camera.left_m * math.cos(yaw)
        z = state.z_m + camera.up_m
        self._eye.set_pos_hpr(x, y, z, math.degrees(yaw) - 90.0, camera.pitch_deg, 0.0)
        return x, y, z

    def shoot(self) -> UInt8[np.ndarray, "h w 3"]:
        """Render the world, and return the picture."""
        self._buffer.set_active(True)
        self._engine.render_frame()
        self._buffer.set_active(False)
        pixels = np.frombuffer(self._pixels.get_ram_image(), np.uint8)
        # Named RGBX so that Pillow averages four plain channels; RGBA would be weighted by alpha.
        plain = Image.frombuffer("RGBX", self._size, pixels, "raw", "RGBX", 0, 1).reduce(self._magnified)
        # The renderer's rows go from the bottom up and its first channel is blue.
        rgb = np.frombuffer(plain.tobytes("raw", "BGR", 0, -1), np.uint8)
        return rgb.reshape(plain.height, plain.width, 3).copy()

    def close(self) -> None:
        """Give the buffer and its memory back."""
        # Panda3D 1.10 keeps the pixels of a buffer that is taken away, but not of one that has become smaller.
        self._buffer.remove_all_display_regions()
        self._buffer.set_size(1, 1)
        self._buffer.set_active(True)
        self._engine.render_frame()
        self._engine.remove_window(self._buffer)
        self._eye.remove_node()
        self._pixels.clear()

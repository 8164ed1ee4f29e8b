"""The textures that are the same in all weathers, and the atlases that let many meshes share one of them."""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable, Mapping, Sequence

import numpy as np
from jaxtyping import UInt8

from roadproof.simulators.town import textures
from roadproof.simulators.town.engine import Texture, make_texture
from roadproof.simulators.town.meshes import Mesh, joined
from roadproof.simulators.town.scenery import FACADES, SHOPS, TREES

ATLAS_COLUMNS = 4
FURNITURE = ("plain", "hedge", "rail")
SOLID_TEXTURES: dict[str, Callable[[], UInt8[np.ndarray, "h w c"]]] = {
    **{f"facade{kind}": functools.partial(textures.facade, kind) for kind in range(FACADES)},
    **{f"shop{kind}": functools.partial(textures.shop_front, kind) for kind in range(SHOPS)},
    "concrete": textures.concrete,
    "roof": textures.roof_tiles,
    "hedge": textures.hedge,
    "rail": textures.guard_rail,
    "plain": textures.plain,
}
TREE_TEXTURES = tuple(f"tree{kind}" for kind in range(TREES))


def static_textures(grain: UInt8[np.ndarray, "g g 3"]) -> dict[str, Texture]:
    """The ground's grains, and what the scenery uses."""
    return {
        "asphalt": make_texture(grain, repeat=True),
        "slabs": make_texture(textures.slab_grain(), repeat=True),
        "grass": make_texture(textures.grass_grain(), repeat=True),
        "shade": make_texture(textures.contact_shadow(), mipmaps=False),
        "solids": make_texture(_solids()),
        "trees": make_texture(_trees()),
    }


@functools.cache
def _solids() -> UInt8[np.ndarray, "h w c"]:
    """The atlas of walls and furniture; drawn once, since every town has the same."""
    return textures.atlas([maker() for maker in SOLID_TEXTURES.values()], ATLAS_COLUMNS)


@functools.cache
def _trees() -> UInt8[np.ndarray, "h w 4"]:
    """The atlas of trees, drawn once too: their thousands of leaves take a quarter of the time of a small street."""
    return textures.atlas([textures.tree(kind) for kind in range(TREES)], ATLAS_COLUMNS)


def split_by_atlas(meshes: Mapping[str, Mesh]) -> tuple[Mesh, Mesh, Mesh]:
    """Walls, furniture and trees from the meshes of a scenery, by texture; the first two share an atlas."""
    walls = {name: mesh for name, mesh in meshes.items() if name not in FURNITURE}
    furniture = {name: mesh for name, mesh in meshes.items() if name in FURNITURE}
    solids = tuple(SOLID_TEXTURES)
    return _with_atlas(walls, solids), _with_atlas(furniture, solids), _with_atlas(meshes, TREE_TEXTURES)


def _with_atlas(meshes: Mapping[str, Mesh], names: Sequence[str]) -> Mesh:
    """The meshes of some textures as one, with the coordinates of the atlas they share."""
    parts = [
        dataclasses.replace(mesh, uv=textures.atlas_uv(mesh.uv, i, ATLAS_COLUMNS, len(names)))
        for i, name in enumerate(names)
        if (mesh := meshes.get(name)) is not None
    ]
    return joined(parts)

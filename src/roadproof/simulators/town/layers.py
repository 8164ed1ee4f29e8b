"""In which order the town is drawn, and how."""

from __future__ import annotations

from enum import IntEnum

from roadproof.simulators.town.engine import Path, core


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

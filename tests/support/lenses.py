"""Lenses of the kinds that people have, and CARLA's camera behind them."""

import dataclasses

from roadproof.geometry import CIL_CAMERA
from roadproof.lens import Lens

BARREL = Lens(model="brown-conrady", coefficients=(-0.12, 0.018, 0.0008, -0.0006, -0.0009))
PINCUSHION = Lens(model="brown-conrady", coefficients=(0.06, 0.004, -0.001, 0.0012, 0.0))
ACTION = Lens(model="fisheye", coefficients=(0.03, -0.008, 0.002, -0.0003))
LENSES = (BARREL, PINCUSHION, ACTION)


def behind(lens):
    """CARLA's camera with a lens."""
    return dataclasses.replace(CIL_CAMERA, lens=lens)

"""Screens for many cameras: the same pictures, in bounded memory."""

import sys
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest

import needs

needs.town()

from roadproof.datatypes import VehicleState, Weather
from roadproof.geometry import CIL_CAMERA, CIL_INPUT, CameraModel
from roadproof.roads.maps import load_map
from roadproof.simulators.town.renderer import Renderer
from roadproof.simulators.town.scenery import build_scenery
from roadproof.simulators.town.screens import KEPT

CAMERA = CameraModel(width_px=320, height_px=240, fov_deg=90.0, up_m=1.4)
HERE = VehicleState(0.0, 0.0, 0.0, 0.5, 0.0)


@pytest.fixture(scope="module")
def renderer():
    roads = load_map("town")
    made = Renderer(roads, build_scenery(roads), CIL_CAMERA, CIL_INPUT)
    made.set_weather(Weather.CLEAR_NOON)
    yield made
    made.close()


def memory_mb():
    lines = Path("/proc/self/status").read_text().splitlines()
    return next(int(line.split()[1]) for line in lines if line.startswith("VmRSS")) / 1024


def test_a_camera_sees_the_same_whatever_others_looked_meanwhile(renderer):
    looks = [replace(CAMERA, pitch_deg=-10.0 * k) for k in range(3)]
    first = [renderer.view(camera, HERE) for camera in looks]
    assert all((a != b).any() for a, b in pairwise(first))
    for k in range(KEPT + 1):
        renderer.view(replace(CAMERA, width_px=64, height_px=48 + k), HERE)
    renderer.forget_views()
    for before, camera in zip(reversed(first), reversed(looks), strict=True):
        np.testing.assert_array_equal(renderer.view(camera, HERE), before)


@pytest.mark.skipif(sys.platform != "linux", reason="reads /proc")
def test_closed_screens_give_their_memory_back(renderer):
    sizes = []
    for k in range(4 * KEPT):
        renderer.view(replace(CAMERA, width_px=320 + 2 * k), HERE)
        sizes.append(memory_mb())
    # A screen of this size has pixels of 2.5 MB.
    assert sizes[-1] < sizes[2 * KEPT] + 15

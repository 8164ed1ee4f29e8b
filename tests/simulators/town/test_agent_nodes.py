"""Which cars and people are drawn: nobody who would be seen is left out."""

import math

import numpy as np
import pytest

import needs
from roadproof.datatypes import VehicleState
from roadproof.geometry import CIL_CAMERA, CameraModel

needs.town()
from roadproof.simulators.town.agent_nodes import in_view

STEEP = CameraModel(width_px=640, height_px=480, fov_deg=60.0, forward_m=1.0, left_m=0.4, up_m=3.0, pitch_deg=-50.0)
SKYWARD = CameraModel(width_px=300, height_px=200, fov_deg=120.0, up_m=1.0, pitch_deg=20.0)


@pytest.mark.parametrize("camera", [CIL_CAMERA, STEEP, SKYWARD])
def test_whoever_has_a_part_in_the_picture_is_in_view(camera: CameraModel) -> None:
    rng = np.random.default_rng(0)
    state = VehicleState(12.0, -7.0, 0.0, 2.1, 5.0)
    middles = rng.uniform(-15, 15, (8000, 2)) + np.array([state.x_m, state.y_m])
    # Points of bodies up to 2.4 m from their middle and 1.8 m high, seen through the exact projection.
    reach, angle = rng.uniform(0, 2.4, 8000), rng.uniform(0, 2 * math.pi, 8000)
    parts = middles + (reach * [np.cos(angle), np.sin(angle)]).T
    points = np.column_stack([parts, rng.uniform(0, 1.8, 8000), np.ones(8000)])
    x, y, depth = camera.image_from_world(state) @ points.T
    inside = (depth > 0.01) & (x > 0) & (x < camera.width_px * depth) & (y > 0) & (y < camera.height_px * depth)
    assert inside.sum() > 50
    assert in_view(camera, state, middles)[inside].all()


def test_those_behind_and_far_beside_are_left_out() -> None:
    state = VehicleState(0.0, 0.0, 0.0, 0.0, 0.0)
    assert not in_view(CIL_CAMERA, state, np.array([[-20.0, 0.0], [5.0, 40.0], [5.0, -40.0]])).any()

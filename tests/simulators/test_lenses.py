"""Simulators that draw through a pinhole refuse lenses; the conformance kit knows where lenses show paint."""

import numpy as np
import pytest

import needs
from lenses import ACTION, LENSES, behind
from references import approach
from roadproof.errors import SimulatorError
from roadproof.simulators.checks import SQUARE_PX, _expected_middle


def test_the_town_refuses_a_lens_in_one_line():
    needs.town()
    from roadproof.simulators.town.simulator import TownSimulator

    with pytest.raises(SimulatorError, match="drawn as a pinhole sees it") as refused:
        TownSimulator(camera=behind(ACTION))
    assert "\n" not in str(refused.value)


def test_carla_refuses_a_lens_in_one_line():
    pytest.importorskip("carla", reason="CARLA's client is not installed: pip install 'roadproof[carla]'")
    from roadproof.simulators.carla.simulator import CarlaSimulator

    with pytest.raises(SimulatorError, match="knows no fisheye lens") as refused:
        CarlaSimulator(camera=behind(ACTION))
    assert "\n" not in str(refused.value)


@pytest.mark.parametrize("lens", (None, *LENSES), ids=str)
def test_the_kit_expects_paint_where_the_lens_shows_it(lens):
    camera, homography = behind(lens), approach(8)[5]
    x, y = np.meshgrid(np.arange(camera.width_px), np.arange(camera.height_px))
    places = np.stack([x.ravel(), y.ravel()], -1).astype(float)
    there, _ = camera.undistorted(places)
    mapped = there @ np.linalg.inv(homography).T
    at = mapped[:, :2] / np.where(mapped[:, 2:] == 0, 1.0, mapped[:, 2:])
    left, top = 150, 220
    low, high = np.array([left, top]) - 0.5, np.array([left, top]) + SQUARE_PX - 0.5
    inside = ((at > low) & (at < high)).all(1) & (mapped[:, 2] > 0)
    assert inside.sum() > 100
    np.testing.assert_allclose(_expected_middle(homography, camera, left, top), places[inside].mean(0), atol=0.3)

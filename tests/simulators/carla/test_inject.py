"""Paint in pictures, against closed forms and a brute-force average."""

import numpy as np
import pytest

from roadproof.datatypes import VehicleState
from roadproof.geometry import CameraModel, CanvasPlacement, homography_from_pose
from roadproof.homographies import apply_homography
from roadproof.simulators.carla.inject import ASPHALT_LEVEL, Paint, Scene

CAMERA = CameraModel(width_px=160, height_px=120, fov_deg=100.0, forward_m=2.0, up_m=1.4, pitch_deg=-15.0)
STATE = VehicleState(0.0, 0.0, 0.0, 0.0, 0.0)
VIEW = homography_from_pose(CAMERA, STATE, CanvasPlacement(x_m=12.0, y_m=0.0))
ROAD = 80


def bare(level=ROAD):
    shape = (CAMERA.height_px, CAMERA.width_px)
    everywhere = np.ones(shape, bool)
    return Scene(np.full((*shape, 3), level, np.uint8), np.zeros(shape), everywhere, everywhere)


def changed(scene):
    return {"picture": scene.picture, "height_m": scene.height_m, "road": scene.road, "asphalt": scene.asphalt}


def opaque(*colour):
    pattern = np.empty((400, 400, 4), np.uint8)
    pattern[:] = (*colour, 255)
    return pattern


def inside(margin_px):
    """Pixels whose centre lies so far inside the canvas, in canvas px."""
    columns, rows = np.meshgrid(np.arange(CAMERA.width_px), np.arange(CAMERA.height_px))
    at = apply_homography(np.linalg.inv(VIEW), np.stack([columns.ravel(), rows.ravel()], -1).astype(float))
    return (np.abs(at - 199.5) < 200 - margin_px).all(-1).reshape(columns.shape)


def test_full_paint_is_lit_as_the_road_is():
    seen = Paint(opaque(255, 128, 0)).on(bare(), VIEW)
    light = ROAD / (255 * ASPHALT_LEVEL)
    expected = np.round(np.array([255, 128, 0]) * light)
    within = inside(60)
    assert within.sum() > 100
    assert np.abs(seen[within].astype(int) - expected).max() <= 1
    outside = ~inside(-60)
    assert (seen[outside] == ROAD).all()


def test_a_road_in_full_light_shows_paint_as_it_is_painted():
    assert (Paint(opaque(255, 255, 255)).on(bare(200), VIEW)[inside(60)] == 255).all()


def test_a_transparent_pattern_changes_nothing():
    pattern = opaque(255, 0, 255)
    pattern[..., 3] = 0
    assert (Paint(pattern).on(bare(), VIEW) == ROAD).all()


def test_each_pixel_shows_the_average_of_the_pattern_in_it():
    rng = np.random.default_rng(3)
    pattern = opaque(0, 0, 0)
    pattern[..., :3] = np.kron(rng.integers(0, 2, (20, 20, 1)), np.ones((20, 20, 3))) * 255
    seen = Paint(pattern).on(bare(255 * ASPHALT_LEVEL // 1), VIEW).astype(float)
    rows, columns = np.nonzero(inside(40))
    fine = (np.arange(64) + 0.5) / 64 - 0.5
    for row, column in list(zip(rows, columns, strict=True))[::97]:
        x, y = np.meshgrid(column + fine, row + fine)
        at = np.rint(apply_homography(np.linalg.inv(VIEW), np.stack([x.ravel(), y.ravel()], -1))).astype(int)
        mean = pattern[at[:, 1].clip(0, 399), at[:, 0].clip(0, 399), 0].mean()
        assert seen[row, column, 0] == pytest.approx(mean, abs=255 * 0.06)


def test_what_stands_on_the_canvas_hides_it():
    scene = bare()
    kinds, heights = changed(scene), changed(scene)
    kinds["road"] = scene.road & (np.arange(160) > 80)
    heights["height_m"] = np.where(np.arange(160) > 80, 0.02, 0.8) + scene.height_m
    free = Paint(opaque(255, 255, 255)).on(scene, VIEW)
    for hidden in (kinds, heights):
        seen = Paint(opaque(255, 255, 255)).on(Scene(**hidden), VIEW)
        assert (seen[:, :81] == ROAD).all()
        assert (seen[:, 81:] == free[:, 81:]).all()


def test_lane_lines_below_the_paint_do_not_brighten_it():
    scene = changed(bare())
    line = np.zeros_like(scene["road"])
    line[:, 70:76] = True
    scene["picture"] = np.where(line[..., None], 230, scene["picture"]).astype(np.uint8)
    scene["asphalt"] = ~line
    seen = Paint(opaque(128, 128, 128)).on(Scene(**scene), VIEW)
    assert np.ptp(seen[inside(60)].astype(int)) <= 1


def test_a_shadow_on_the_road_lies_on_the_paint_too():
    scene = changed(bare())
    scene["picture"][:, :80] = 40
    seen = Paint(opaque(200, 200, 200)).on(Scene(**scene), VIEW).astype(float)
    within = inside(60)
    left, right = within & (np.arange(160) < 70), within & (np.arange(160) > 90)
    assert seen[right].mean() / seen[left].mean() == pytest.approx(2.0, rel=0.03)


def test_a_canvas_out_of_sight_changes_nothing():
    behind = homography_from_pose(CAMERA, STATE, CanvasPlacement(x_m=-30.0, y_m=0.0))
    scene = bare()
    assert (Paint(opaque(255, 255, 255)).on(scene, behind) == scene.picture).all()

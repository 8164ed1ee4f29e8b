"""The published calibration's parts against targets drawn by hand."""

import numpy as np

from roadproof.calibration.published import (
    COLOURS,
    PAINTS,
    POINTS,
    RUNS,
    calibration_points,
    detect_points,
    points_target,
)


def test_sixty_points_lie_apart_and_inside_and_are_always_the_same():
    points = calibration_points()
    assert points.shape == (POINTS, 2) == (RUNS * len(COLOURS), 2)
    assert points.min() >= 10
    assert points.max() <= 389
    apart = np.hypot(*(points[:, None] - points[None]).transpose(2, 0, 1)) + 1e3 * np.eye(POINTS)
    assert apart.min() >= 44
    np.testing.assert_array_equal(points, calibration_points())


def test_discs_drawn_are_discs_found_within_their_radius():
    points = np.array([[30.0, 40.0], [200.0, 60.0], [350.0, 90.0], [60.0, 300.0], [333.0, 333.0]])
    found = detect_points(points_target(points)[..., :3])
    assert np.hypot(*(found - points).T).max() <= 4.5


def test_colours_that_are_not_seen_are_nan_and_grey_roads_show_none():
    assert np.isnan(detect_points(np.full((60, 80, 3), 120, np.uint8))).all()
    picture = np.full((60, 80, 3), 20, np.uint8)
    picture[30, 40] = (200, 10, 10)
    found = detect_points(picture)
    np.testing.assert_array_equal(found[0], [40, 30])
    assert np.isnan(found[1:]).all()


def test_there_are_the_published_number_of_colours_all_different():
    assert len(set(PAINTS)) == 22

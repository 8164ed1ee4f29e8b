from __future__ import annotations

import numpy as np
import pytest

from roadproof.attacks.expected_improvement import ExpectedImprovement, most_promising

RANGES = np.array([180.0, 400.0, 250.0])
WAVES = np.array([40.0, 90.0, 60.0])


def wavy(points):
    return np.sin(points / WAVES).sum(-1)


@pytest.fixture(scope="module")
def process():
    gaussian_process = pytest.importorskip("sklearn.gaussian_process", reason="scikit-learn is not installed")
    points = np.random.default_rng(0).uniform(size=(60, 3)) * RANGES
    kernel = gaussian_process.kernels.Matern(nu=2.5)
    fitted = gaussian_process.GaussianProcessRegressor(kernel, alpha=1e-6, n_restarts_optimizer=5, random_state=0)
    return fitted.fit(points, wavy(points))


def test_points_one_by_one_and_in_blocks_are_valued_as_the_library_predicts(process):
    improvement = ExpectedImprovement(process)
    points = np.random.default_rng(1).uniform(size=(600, 3)) * RANGES
    each = np.array([-improvement.negative(point)[0] for point in points])
    assert np.allclose(each, improvement.at(points), rtol=1e-4, atol=1e-9)
    assert (each > 0).any()


def test_its_gradient_is_that_of_differences(process):
    improvement = ExpectedImprovement(process)
    steps = 1e-3 * np.eye(3)
    for point in np.random.default_rng(2).uniform(size=(50, 3)) * RANGES:
        by_differences = [
            (improvement.negative(point + step)[0] - improvement.negative(point - step)[0]) / 2e-3 for step in steps
        ]
        assert np.allclose(improvement.negative(point)[1], by_differences, rtol=1e-3, atol=1e-8)


def test_where_nothing_is_in_doubt_nothing_is_expected(process):
    improvement = ExpectedImprovement(process)
    lowest = process.X_train_[process.y_train_.argmin()]
    value, slope = improvement.negative(lowest)
    assert abs(value) < 1e-6
    assert np.isfinite(slope).all()


def test_the_most_promising_point_is_better_than_any_drawn(process):
    improvement = ExpectedImprovement(process)
    best = most_promising(process, RANGES, np.random.RandomState(3), drawn=200, climbs=20)
    assert ((best >= 0) & (best <= RANGES)).all()
    random = np.random.default_rng(4).uniform(size=(20_000, 3)) * RANGES
    assert improvement.at(best[None])[0] >= improvement.at(random).max()
    again = most_promising(process, RANGES, np.random.RandomState(3), drawn=200, climbs=20)
    assert (best == again).all()

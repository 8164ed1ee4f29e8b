"""The checks of types and shapes do check: a test that passes under them says something."""

import numpy as np
import pytest
import torch
from beartype.roar import BeartypeCallHintParamViolation
from jaxtyping import TypeCheckError

import type_checks
from roadproof.coverage import Shape
from roadproof.datatypes import Control
from roadproof.driving.deviation import deviation_m
from roadproof.driving.intervals import mean_95
from roadproof.geometry import CameraModel
from roadproof.patterns import Pattern


def test_a_wrong_type_is_refused():
    with pytest.raises(BeartypeCallHintParamViolation, match="steer"):
        Control("left")
    with pytest.raises(BeartypeCallHintParamViolation, match="values"):
        mean_95(3)
    with pytest.raises(BeartypeCallHintParamViolation, match="width_px"):
        CameraModel(width_px="wide", height_px=480, fov_deg=100.0, forward_m=2.0, up_m=1.4, pitch_deg=-15.0)


def test_a_wrong_shape_is_refused():
    with pytest.raises(TypeCheckError, match="deviation_m"):
        deviation_m(np.zeros((4, 3)), np.zeros((4, 2)))


def test_a_name_in_shapes_means_one_size_throughout_a_call():
    with pytest.raises(TypeCheckError, match="k=2"):
        Pattern((Shape.RECTANGLE,) * 2, torch.zeros(2, 5), torch.zeros(3, 3))


def test_the_first_calls_are_checked_and_those_of_the_next_test_again():
    calls = range(type_checks.CHECKED_CALLS)
    assert {mean_95([1.0, 2.0]).value for _ in calls} == {1.5}
    with pytest.raises(TypeError):  # its own, from a call that nobody checks
        mean_95(None)
    type_checks.begin_test()
    with pytest.raises(BeartypeCallHintParamViolation, match="values"):
        mean_95(None)

"""A controller is known by what it answers."""

import pickle

import pytest

from paint_shy import PaintShy
from roadproof.controllers import load_controller
from roadproof.controllers.identity import answers_of, identity_of
from roadproof.errors import ControllerError
from roadproof.training.expert import expert

SIZE = (88, 200)


def test_the_same_controller_is_the_same_however_it_came_here():
    assert identity_of(PaintShy(), SIZE) == identity_of(PaintShy(), SIZE)
    assert identity_of(pickle.loads(pickle.dumps(PaintShy())), SIZE) == identity_of(PaintShy(), SIZE)
    assert identity_of(load_controller("pilotnet"), SIZE) == identity_of(load_controller("pilotnet"), SIZE)


def test_one_that_answers_otherwise_is_another_whatever_it_is_called():
    assert identity_of(PaintShy(), SIZE) != identity_of(PaintShy(gain=4.5), SIZE)
    named = [identity_of(load_controller(name), SIZE) for name in ("pilotnet", "cil", "cil-small")]
    assert len(set(named)) == 3


def test_a_function_is_known_by_the_name_that_its_user_gives_it():
    assert identity_of(expert, SIZE) == ""


def test_answers_are_few_and_plain():
    answers = answers_of(PaintShy(), SIZE)
    assert len(answers) == 4
    assert all(len(each) == 3 and round(each[0], 4) == each[0] for each in answers)

    class Silent(PaintShy):
        def act(self, frame, speed_mps, command):
            return None

    with pytest.raises(ControllerError, match="act"):
        answers_of(Silent(), SIZE)

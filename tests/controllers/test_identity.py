"""A controller is known by what it answers."""

import pickle
from functools import partial

import numpy as np
import pytest
from torch import nn

from paint_shy import PaintShy
from roadproof.controllers import load_controller
from roadproof.controllers.identity import answers_of, architecture_of, identity_of, parts_of
from roadproof.datatypes import Control
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


def test_weights_that_no_answer_shows_count_too():
    """A branch of another command, or a change too small for four digits."""
    known, unseen = parts_of(load_controller("pilotnet"), SIZE), 0
    for name in load_controller("pilotnet").state_dict():
        other = load_controller("pilotnet")
        other.state_dict()[name].add_(1e-5)
        found = parts_of(other, SIZE)
        assert found["controller_digest"] != known["controller_digest"], name
        unseen += found["answers"] == known["answers"]
    assert unseen >= 24


class Classical:
    """It looks for one colour, of which noise has none; it counts what it is asked, and keeps a grid."""

    input_size = None

    def __init__(self, gain, at_left=0.0):
        self.gain, self.at_left, self.asked, self._grid = gain, at_left, 0, None

    def steer(self, frames, speed_mps, command):
        raise NotImplementedError

    def act(self, frame, speed_mps, command):
        self.asked += 1
        self._grid = np.arange(frame.shape[1]) if self._grid is None else self._grid
        seen = (frame == (1, 2, 3)).all(2).mean()
        return Control(self.gain * seen + (self.at_left if command == 3 else 0.0))


class Seldom(Classical):
    """It knows nothing but following the lane."""

    def act(self, frame, speed_mps, command):
        if command != 2:
            raise ValueError(command)
        return super().act(frame, speed_mps, command)


def test_a_controller_without_weights_is_known_by_its_settings_and_its_answers_to_all_commands():
    one = Classical(4.0)
    known = identity_of(one, SIZE)
    assert known == identity_of(one, SIZE) == identity_of(Classical(4.0), SIZE), "counting and keeping changes nothing"
    assert known != identity_of(Classical(1.0), SIZE)
    turning = Classical(4.0)
    turning.act = lambda frame, speed_mps, command: Control(0.1 * (command == 3))
    assert known != identity_of(turning, SIZE)
    set_later = Classical(4.0)
    set_later.gain = 5.0
    assert known != identity_of(set_later, SIZE)
    assert identity_of(Seldom(1.0), SIZE) == identity_of(Seldom(1.0), SIZE)


def test_a_function_of_the_users_is_known_by_its_source_and_what_it_was_given():
    def made(gain):
        return lambda world: gain

    assert identity_of(made(1.0), SIZE) == identity_of(made(1.0), SIZE) != identity_of(made(2.0), SIZE)
    assert identity_of(partial(expert, 1), SIZE) != identity_of(partial(expert, 2), SIZE)


def test_an_architecture_is_known_by_its_shapes_not_its_weights():
    one, other = load_controller("pilotnet"), load_controller("pilotnet-b")
    assert architecture_of(one) == architecture_of(other) != architecture_of(load_controller("cil-small"))
    assert architecture_of(load_controller("cil-small")) != architecture_of(load_controller("cil"))


def test_an_architecture_is_known_by_its_layers_also_within_a_class_that_is_no_module():
    class Mine(PaintShy):
        def __init__(self, network):
            super().__init__()
            self.network = network

    def net(activation):
        return nn.Sequential(nn.Flatten(), nn.Linear(12, 4), activation, nn.Linear(4, 1))

    one, again, other = (architecture_of(Mine(net(layer))) for layer in (nn.ReLU(), nn.ReLU(), nn.Tanh()))
    assert one == again != other
    held = [architecture_of(Mine([{"one": net(layer)}])) for layer in (nn.ReLU(), nn.Tanh())]
    assert held[0] != held[1]
    assert architecture_of(Mine(load_controller("pilotnet"))) != architecture_of(Mine(load_controller("waypoint")))
    assert architecture_of(Mine(None)).endswith("Mine")

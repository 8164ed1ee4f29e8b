"""The controllers that come with the package: they load by name, keep their promises, and their cards are whole."""

import pytest

from roadproof.controllers import check_controller, load_controller, model_card, shipped_names
from roadproof.controllers.shipped import FOLDER, shipped_weights
from roadproof.errors import ControllerError


@pytest.mark.parametrize("name", shipped_names())
def test_a_shipped_controller_keeps_the_promises_that_attacks_rely_on(name):
    check_controller(load_controller(name)).require()


@pytest.mark.parametrize("name", shipped_names())
def test_every_shipped_controller_has_a_whole_card(name):
    card = model_card(name)
    assert card.name == name
    for text in (card.summary, card.network, card.data, card.training, card.can, card.cannot):
        assert len(text) > 10


def test_what_is_shipped_is_small():
    assert {"cil", "pilotnet"} <= set(shipped_names())
    assert sum(shipped_weights(name).stat().st_size for name in shipped_names() if "-" not in name) <= 20e6
    assert {path.stem for path in FOLDER.glob("*.toml")} == set(shipped_names())


def test_an_unknown_name_gets_the_nearest():
    with pytest.raises(ControllerError, match="did you mean 'cil'"):
        shipped_weights("cli")

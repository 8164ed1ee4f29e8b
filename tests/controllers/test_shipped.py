"""The shipped controllers: they load by name, keep their promises, and their cards are whole.

Some of the weights are a distribution of their own: without it, all that needs none of them works as well.
"""

import sys

import pytest

from roadproof.controllers import check_controller, load_controller, model_card, shipped_names
from roadproof.controllers.shipped import FOLDER, installed_weights, shipped_weights
from roadproof.errors import ControllerError

LARGE = ["cil", "cil-hardened", "cil-small"]


@pytest.fixture
def without_large(monkeypatch):
    """As where the extra `cil` is not installed: None is how Python itself marks a package that is not there."""
    monkeypatch.setitem(sys.modules, "roadproof_cil", None)


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
    assert sum(path.stat().st_size for path in FOLDER.iterdir()) <= 10e6
    assert sum(shipped_weights(name).stat().st_size for name in shipped_names() if "-" not in name) <= 20e6
    assert {path.stem for path in FOLDER.glob("*.safetensors")} <= set(shipped_names())


def test_without_the_large_weights_the_small_ones_load(without_large):
    assert [name for name in shipped_names() if installed_weights(name) is None] == LARGE
    assert load_controller("pilotnet").input_size


@pytest.mark.parametrize("name", LARGE)
def test_without_the_large_weights_their_controllers_have_cards_and_say_what_to_install(without_large, name):
    assert name in shipped_names()
    assert model_card(name).name == name
    said = f"^the controller '{name}' needs its weights, which are not installed: pip install 'roadproof\\[cil\\]'$"
    with pytest.raises(ControllerError, match=said):
        load_controller(name)


@pytest.mark.parametrize("ask", [installed_weights, shipped_weights, model_card])
def test_an_unknown_name_gets_the_nearest_whatever_is_installed(without_large, ask):
    with pytest.raises(ControllerError, match="did you mean 'cil'"):
        ask("cli")

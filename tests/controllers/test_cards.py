"""Cards: what is written is read back; what is wrong is said in one line."""

import json

import pytest

from roadproof.controllers import PILOTNET_ON_CARLA, ControllerCard, LinearMPC, PurePursuit
from roadproof.controllers.cards import read_card
from roadproof.errors import ControllerError


def card(**stated):
    return json.dumps({"format": "roadproof-controller", "version": 1} | stated)


@pytest.mark.parametrize(
    "written",
    [
        ControllerCard(),
        ControllerCard(architecture="cil", width=0.5, origin="a checkpoint"),
        ControllerCard(architecture="waypoint", tracking=PurePursuit(sight_m=3.0)),
        ControllerCard(tracking=LinearMPC(pieces=6), dt_s=0.25),
        ControllerCard(architecture="pilotnet", activation="relu", target_speed_mps=8.0, preparation=PILOTNET_ON_CARLA),
    ],
)
def test_a_card_is_read_as_it_was_written(written):
    assert read_card(written.to_json(), "x") == written


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("{", "card net.json is not JSON"),
        (100_000 * "[", "card net.json is not JSON"),
        (card(width=0).replace("0", "9" * 5000), "card net.json is not JSON: an integer has 5000 digits"),
        ("[1]", r"holds \[1\] where a JSON object is expected"),
        ("{}", "not a controller card"),
        (card(version=2), "has version 2, this roadproof reads version 1"),
        (card(architectur="cil"), "unknown key 'architectur'; did you mean 'architecture'"),
        (card(preparation={"color": "yuv"}), "unknown key 'color'; did you mean 'colour'"),
        (card(width="half"), "width is 'half', expected float"),
        (card(width=True), "width is True, expected float"),
        (card(activation=3), "activation is 3, expected str"),
        (card(preparation={"rows": [1, 2, 3]}), "rows is .* expected array of length 2, got 3"),
        (card(preparation={"rows": [1.5, 2]}), r"rows\[0\] is 1.5, expected int, got float"),
        (card(preparation={"colour": "hsv"}), "colour is 'hsv'"),
        (card(tracking={"law": "stanley"}), "tracking needs a law, one of pure-pursuit, linear-mpc"),
        (card(tracking={"sight_m": 3}), "tracking needs a law"),
        (card(tracking={"law": "pure-pursuit", "sigth_m": 3}), "unknown key 'sigth_m'; did you mean 'sight_m'"),
        (card(tracking={"law": "linear-mpc", "pieces": 2.5}), "pieces is 2.5, expected int, got float"),
        (card(tracking={"law": "pure-pursuit", "wheelbase_m": -1}), "wheelbase_m of the tracking law is -1"),
        (card(dt_s="half"), "dt_s is 'half', expected float"),
        (card(dt_s=0.5), "dt_s is 0.5, but only exported networks with a tracking law"),
        (card(architecture="waypoint", tracking={"law": "pure-pursuit"}, dt_s=0.5), "only exported networks"),
        (card(architecture="cil", tracking={"law": "pure-pursuit"}), "cil steers; drop it"),
        (card(architecture="cil", preparation={"colour": "yuv"}), "preparation is .*, for which cil has no use; drop"),
        (card(architecture="conditional-pilotnet", activation="relu"), "activation is 'relu', for which conditional-"),
        (card(architecture="temporal", target_speed_mps=9), "target_speed_mps is 9.0, for which temporal has no use"),
        (card(width=0.5), "width is 0.5, for which an exported network has no use"),
        (card(preparation=4), "preparation is 4, expected table"),
        (card(tracking=4), "where a JSON object is expected"),
    ],
)
def test_what_is_wrong_is_said_in_one_line(text, message):
    with pytest.raises(ControllerError, match=message) as refusal:
        read_card(text, "net.json")
    assert "\n" not in str(refusal.value)

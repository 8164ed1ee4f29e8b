"""Weights files: saved, read with their card, refused where they do not fit."""

import os
import shutil

import numpy as np
import pytest
import torch
from safetensors.torch import load_file, save_file

from roadproof.controllers import (
    CIL,
    ControllerCard,
    CruiseControl,
    FramePreparation,
    SteeringController,
    load_controller,
    pilotnet_controller,
    save_controller,
)
from roadproof.controllers.weights_file import ARCHITECTURES, fill_from
from roadproof.errors import ControllerError, OutputError
from roadproof.io.text import MOST_TEXT_BYTES


def test_a_card_beside_bare_weights_says_the_rest(pilotnet_data, tmp_path):
    weights = tmp_path / "net.safetensors"
    shutil.copy(pilotnet_data / "pilotnet.safetensors", weights)
    with pytest.raises(ControllerError, match=r"says nothing about its architecture.*pilotnet:.*net\.json"):
        load_controller(weights)
    rows = FramePreparation(frame_size=(88, 200), rows=(10, 76), network_size=(66, 200))
    card = ControllerCard(architecture="pilotnet", activation="relu", preparation=rows)
    weights.with_suffix(".json").write_text(card.to_json())
    controller = load_controller(weights)
    assert isinstance(controller, SteeringController)
    assert controller.preparation == rows
    assert controller.network.activation == "relu"


def test_a_card_in_the_file_counts_also_where_the_architecture_is_named(tmp_path):
    path = tmp_path / "net.safetensors"
    made = pilotnet_controller(activation="relu", cruise=CruiseControl(target_mps=9.0))
    save_controller(made, path)
    again = load_controller(f"pilotnet:{path}")
    assert (again.network.activation, again.cruise.target_mps) == ("relu", 9.0)
    with pytest.raises(ControllerError, match="says that it is 'pilotnet', not 'cil'; give the path alone"):
        load_controller(f"cil:{path}")


def test_bare_cil_weights_are_the_published_size(tmp_path):
    save_file(CIL(seed=1).state_dict(), tmp_path / "cil.safetensors")
    assert load_controller(f"cil:{tmp_path / 'cil.safetensors'}").input_size == (88, 200)
    save_file(CIL(width=0.1).state_dict(), tmp_path / "small.safetensors")
    with pytest.raises(ControllerError, match=r"tensor .* has shape .*, expected .* for this CIL"):
        load_controller(f"cil:{tmp_path / 'small.safetensors'}")


def test_damaged_and_unfitting_weights_are_refused(cil, tmp_path):
    path = tmp_path / "net.safetensors"
    path.write_bytes(b"not tensors")
    with pytest.raises(ControllerError, match="not a safetensors file or is damaged"):
        load_controller(path)
    save_controller(cil, path)
    state = load_file(path)
    spec = f"cil:{path}"

    def refused(changed, message):
        save_file(changed, path)
        with pytest.raises(ControllerError, match=message):
            load_controller(spec)

    refused({name: value for name, value in state.items() if name != "join.0.bias"}, r"lacks tensor join\.0\.bias")
    refused(state | {"extra": torch.zeros(1)}, "has an unexpected tensor extra")
    full = CIL().state_dict()
    refused(full | {"join.0.bias": torch.full((512,), np.nan)}, r"join\.0\.bias has NaN")
    for kind in (torch.int8, torch.bool, torch.complex64):
        refused(full | {"join.0.bias": torch.zeros(512, dtype=kind)}, rf"join\.0\.bias is of type {kind}, expected")
    eighths = torch.full((512,), np.nan).to(torch.float8_e4m3fn)
    refused(full | {"join.0.bias": eighths}, r"join\.0\.bias has NaN")


class Masked(torch.nn.Module):
    """A network with a mask of attention, which no weights change."""

    def __init__(self):
        super().__init__()
        self.scale = torch.nn.Parameter(torch.ones(2))
        self.register_buffer("mask", torch.tensor([0.0, -torch.inf]))


def test_a_mask_of_a_networks_own_may_be_infinite_and_no_other_number(tmp_path):
    path, network = tmp_path / "masked.safetensors", Masked()
    save_file({"scale": torch.full((2,), 3.0), "mask": network.mask}, path)
    fill_from(path, network)
    assert network.scale.tolist() == [3.0, 3.0]
    save_file({"scale": torch.full((2,), 3.0), "mask": -network.mask}, path)
    with pytest.raises(ControllerError, match="tensor mask has NaN or infinite values"):
        fill_from(path, network)


def test_a_card_beside_weights_counts_also_where_the_architecture_is_named(tmp_path):
    path, card = tmp_path / "net.safetensors", ControllerCard(architecture="pilotnet", target_speed_mps=9.0)
    save_file(pilotnet_controller().network.state_dict(), path)
    path.with_suffix(".json").write_text(card.to_json())
    assert load_controller(f"pilotnet:{path}").cruise.target_mps == 9.0
    with pytest.raises(ControllerError, match=r"net\.json says that it is 'pilotnet', not 'cil'; give the path alone"):
        load_controller(f"cil:{path}")
    path.with_suffix(".json").write_text(ControllerCard(target_speed_mps=8.0).to_json())
    assert load_controller(f"pilotnet:{path}").cruise.target_mps == 8.0
    path.with_suffix(".json").write_text('{"loss": [0.1]}')
    assert load_controller(f"pilotnet:{path}").cruise.target_mps == 6.0, "it is no card"
    with pytest.raises(ControllerError, match="is not a controller card"):
        load_controller(path)


def test_a_card_is_read_within_bounds_and_from_a_file(tmp_path):
    path = tmp_path / "net.safetensors"
    save_file(pilotnet_controller().network.state_dict(), path)
    if hasattr(os, "mkfifo"):
        os.mkfifo(path.with_suffix(".json"))
        assert load_controller(f"pilotnet:{path}").cruise.target_mps == 6.0, "nobody writes into that pipe"
        path.with_suffix(".json").unlink()
    path.with_suffix(".json").write_text(" " * (MOST_TEXT_BYTES + 1))
    with pytest.raises(ControllerError, match=r"cannot read the card .*net\.json: it is larger than 33,554,432 bytes"):
        load_controller(path)


def test_what_cannot_be_saved_is_said(cil, tmp_path):
    with pytest.raises(ControllerError, match="folded CIL"):
        save_controller(cil.folded(), tmp_path / "x.safetensors")
    with pytest.raises(ControllerError, match="cannot save a Identity"):
        controller = SteeringController(torch.nn.Identity(), preparation=FramePreparation())
        save_controller(controller, tmp_path / "x.safetensors")
    with pytest.raises(ControllerError, match=r"a card cannot hold CruiseControl\(.*hold=0\.1\), expected"):
        save_controller(pilotnet_controller(cruise=CruiseControl(hold=0.1)), tmp_path / "x.safetensors")
    with pytest.raises(ControllerError, match="dtype is 'bfloat16', expected 'float16' or 'float32'"):
        save_controller(cil, tmp_path / "x.safetensors", dtype="bfloat16")
    large = CIL(width=0.1)
    with torch.no_grad():
        large.join[0].bias[0] = 70_000.0
    with pytest.raises(ControllerError, match=r"join\.0\.bias has NaN or numbers too large for float16"):
        save_controller(large, tmp_path / "x.safetensors", dtype="float16")
    (tmp_path / "file").write_text("")
    with pytest.raises(OutputError, match="cannot write"):
        save_controller(cil, tmp_path / "file" / "x.safetensors")
    assert not list(tmp_path.glob("*.part"))


def test_a_file_that_says_it_is_far_larger_than_it_is_is_refused_before_the_network_takes_memory(tmp_path, monkeypatch):
    path, made = tmp_path / "hostile.safetensors", list[str]()
    build = ARCHITECTURES["cil"]

    def watched(card):
        made.append(torch.empty(0).device.type)
        return build(card)

    monkeypatch.setitem(ARCHITECTURES, "cil", watched)
    save_controller(CIL(width=1 / 32), path)
    fits = dict(load_file(path))
    assert isinstance(load_controller(str(path)), CIL)
    assert made == ["meta", "cpu"]
    save_file(fits, path, {"roadproof": ControllerCard(architecture="cil", width=8.0).to_json()})
    with pytest.raises(ControllerError, match=r"has shape .* for this CIL"):
        load_controller(str(path))
    assert made == ["meta", "cpu", "meta"]

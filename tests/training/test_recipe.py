"""The whole recipe, tiny: every stage leaves its files, nothing is done twice, and another recipe is refused."""

import json
from dataclasses import asdict, replace

import pytest

import needs
from roadproof.controllers import CIL, ConditionalPilotNet, TrajectoryController, load_controller, save_controller
from roadproof.errors import TrainingError
from roadproof.training.recipe import Recipe, _claim, follow, gather

needs.town()

TINY = Recipe(width=0.05, seed=4, drives=1, samples=256, rounds=1, round_drives=1, round_samples=256)


def test_a_recipe_is_followed_stage_by_stage_and_only_once(tmp_path):
    told = []
    weights = follow(TINY, tmp_path, on_stage=lambda title, *_: told.append(title))
    assert list(dict.fromkeys(told)) == [
        "Driving (expert)",
        "Learning from the expert",
        "Round 1, the network drives",
        "Round 1, learning",
    ]
    files = sorted(str(path.relative_to(tmp_path)) for path in tmp_path.rglob("*") if path.is_file())
    assert files == [
        "cil.safetensors",
        "drives/expert/drive-00000.npz",
        "drives/round-1/drive-00000.npz",
        "network-0.safetensors",
        "network-1.safetensors",
        "recipe.json",
    ]
    assert isinstance(load_controller(weights), CIL)
    assert weights.stat().st_size < 0.55 * (tmp_path / "network-1.safetensors").stat().st_size
    told.clear()
    # As one leaves it that is ended between keeping the network and removing how far its training was.
    left = tmp_path / "network-1.ckpt"
    left.touch()
    before = {path: path.stat().st_mtime_ns for path in tmp_path.rglob("*.npz")}
    again = follow(TINY, tmp_path, on_stage=lambda title, *_: told.append(title))
    assert (told, again) == ([], weights)
    assert {path: path.stat().st_mtime_ns for path in tmp_path.rglob("*.npz")} == before
    assert not left.exists()


def test_drives_can_be_collected_alone_and_learnt_from_later(tmp_path):
    recipe = Recipe(network="pilotnet", drives=1, painted_drives=1, samples=128, rounds=0)
    shards = gather(recipe, tmp_path)
    assert [path.parent.name for path in shards] == ["expert", "painted"]
    assert isinstance(load_controller(follow(recipe, tmp_path)), ConditionalPilotNet)


def test_a_folder_of_another_recipe_is_refused(tmp_path):
    begun = asdict(replace(TINY, drives=7))
    (tmp_path / "recipe.json").write_text(json.dumps({"format": "roadproof-recipe", "version": 1, "recipe": begun}))
    with pytest.raises(TrainingError, match="holds a training with drives 7, now it is 1"):
        follow(TINY, tmp_path)


def test_a_folder_that_began_with_other_weights_of_the_same_name_is_refused(tmp_path):
    begun = replace(TINY, start=str(tmp_path / "start.safetensors"))
    save_controller(CIL(width=0.05, seed=11), tmp_path / "start.safetensors")
    _claim(begun, tmp_path)
    _claim(begun, tmp_path)
    save_controller(CIL(width=0.05, seed=12), tmp_path / "start.safetensors")
    with pytest.raises(TrainingError, match="holds a training with weights of start"):
        _claim(begun, tmp_path)


def test_a_recipe_may_start_from_weights(tmp_path):
    save_controller(CIL(width=0.05, seed=11), tmp_path / "start.safetensors")
    network = Recipe(start=str(tmp_path / "start.safetensors")).fresh()
    assert isinstance(network, CIL)
    assert network.width == 0.05
    assert not network.is_folded
    with pytest.raises(TrainingError, match=r"width is 0.5, but start .* has 0.05; leave it out"):
        Recipe(start=str(tmp_path / "start.safetensors"), width=0.5).fresh()
    with pytest.raises(TrainingError, match="pilotnet has one width"):
        Recipe(network="pilotnet", width=0.5)
    assert isinstance(Recipe(network="pilotnet", start="pilotnet").fresh(), ConditionalPilotNet)
    assert isinstance(Recipe(network="waypoint").fresh(), TrajectoryController)


@pytest.mark.parametrize(("network", "start"), [("cil", "pilotnet"), ("waypoint", "temporal")])
def test_weights_of_another_network_are_refused_before_anything_is_driven(tmp_path, network, start):
    with pytest.raises(TrainingError, match=f"start {start} is a .*, network {network} a .*; give the network"):
        follow(Recipe(network=network, start=start, drives=1, samples=128), tmp_path / "out")
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("changes", [{"network": "resnet"}, {"rounds": -1}, {"painted_drives": -2}, {"seed": -1}])
def test_recipes_that_make_no_sense_are_refused(changes):
    with pytest.raises(TrainingError, match=next(iter(changes))):
        Recipe(**changes)

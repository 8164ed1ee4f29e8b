"""How results show themselves in a notebook."""

import dataclasses
import io

import numpy as np
import pytest
import torch
from PIL import Image

from pages import HOSTILE, Page
from roadproof.attacks import AttackResult
from roadproof.attacks.driven import Effect
from roadproof.drives import Drives
from roadproof.errors import OutputError, TrainingError
from roadproof.hardening import Hardened
from roadproof.patterns import Pattern, raster
from roadproof.pipeline.stress_test import StressTest
from roadproof.scenarios import find_scenario
from roadproof.simulators.protocol import PaintKind
from runs import CRASH, PATTERN, driven, hardened, write_attack, write_evaluation, write_record


def test_a_pattern_is_a_picture_and_a_batch_is_none():
    shown = Image.open(io.BytesIO(PATTERN._repr_png_()))
    assert np.array_equal(np.asarray(shown), raster(PATTERN))
    batch = Pattern(PATTERN.shapes, torch.stack([PATTERN.boxes] * 2), torch.stack([PATTERN.colours] * 2))
    assert batch._repr_png_() is None


def test_an_attack_shows_its_pattern_and_each_kind_of_number_by_name(tmp_path):
    write_attack(tmp_path)
    found = AttackResult.load(tmp_path)
    page = Page(found._repr_html_())
    assert page.all("img")[0]["src"].startswith("data:image/png;base64,")
    assert f"surrogate {found.surrogate_shift:+.3f} steer a frame" in page.text
    assert "predicted" not in page.text
    driven = dataclasses.replace(found, surrogate_shift=None, driven=Effect(0.4, 1.25), predicted_m=0.9)
    page = Page(driven._repr_html_())
    assert "predicted 0.90 m" in page.text
    assert "driven, to choose it 1.25 m" in page.text
    assert "surrogate" not in page.text
    assert "<script" not in dataclasses.replace(found, objective=HOSTILE)._repr_html_()


def test_an_evaluation_is_a_table_that_says_driven_or_predicted(tmp_path):
    evaluation = write_evaluation(tmp_path)
    page = Page(evaluation._repr_html_())
    assert len(page.all("tr")) == 1 + len(evaluation.rows())
    assert "driven m" in page.text
    predicted = dataclasses.replace(evaluation, paint=PaintKind.COMPOSITED)
    assert "driven m" not in Page(predicted._repr_html_()).text


def test_recorded_drives_survive_their_folder_and_are_a_table(tmp_path):
    write_record(tmp_path / "one", find_scenario("left-03"))
    drives = Drives.load(tmp_path / "one")
    drives.save(tmp_path / "two")
    loaded = Drives.load(tmp_path / "two")
    assert loaded.settings == drives.settings
    for one, two in zip(drives.drives, loaded.drives, strict=True):
        assert np.array_equal(one.frames, two.frames)
        assert np.array_equal(one.episode.x_m, two.episode.x_m)
    page = Page(loaded._repr_html_())
    assert len(page.all("tr")) == 1 + 3
    assert "right 4 +1.50 perturbed less than asked" in page.text
    with pytest.raises(OutputError, match="clean"):
        drives.save(tmp_path / "two")


def test_an_episode_says_how_it_ended():
    text = Page(driven(find_scenario("left-03"), events=CRASH, traffic=True)._repr_html_()).text
    assert "scenario left-03, clear-noon" in text
    assert "paint none" in text
    assert "20 cars, 20 pedestrians, seed 0" in text
    assert "collision-static at 6.0 s" in text


def test_a_hardening_survives_its_file_and_shows_rounds_and_verdict(tmp_path):
    found = hardened()
    found.save(tmp_path)
    assert Hardened.load(tmp_path) == found
    text = Page(found._repr_html_()).text
    assert "round 0 1.10 m, leaves its lane in 55%" in text
    assert found.judgement.verdict().sentence in text
    without = dataclasses.replace(found, judgement=None)
    without.save(tmp_path)
    assert Hardened.load(tmp_path) == without
    (tmp_path / "hardening.json").write_text("{}")
    with pytest.raises(TrainingError, match=r"hardening\.json"):
        Hardened.load(tmp_path)


def test_a_stress_test_shows_both(tmp_path):
    write_attack(tmp_path / "attack")
    attack, evaluation = AttackResult.load(tmp_path / "attack"), write_evaluation(tmp_path / "evaluation")
    nothing = dict.fromkeys(("selection", "rounds", "prediction", "fidelity"))
    whole = StressTest(attack=attack, evaluation=evaluation, cost={}, **nothing)
    html = whole._repr_html_()
    assert attack._repr_html_() in html
    assert evaluation._repr_html_() in html

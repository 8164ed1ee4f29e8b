"""How results show themselves in a notebook."""

import dataclasses
import io

import numpy as np
import torch
from PIL import Image

from pages import HOSTILE, Page
from roadproof.attacks import AttackResult
from roadproof.attacks.driven import Effect
from roadproof.patterns import Pattern, raster
from roadproof.pipeline.stress_test import StressTest
from roadproof.simulators.protocol import PaintKind
from runs import PATTERN, write_attack, write_evaluation


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


def test_a_stress_test_shows_both(tmp_path):
    write_attack(tmp_path / "attack")
    attack, evaluation = AttackResult.load(tmp_path / "attack"), write_evaluation(tmp_path / "evaluation")
    nothing = dict.fromkeys(("selection", "rounds", "prediction", "fidelity"))
    whole = StressTest(attack=attack, evaluation=evaluation, cost={}, **nothing)
    html = whole._repr_html_()
    assert attack._repr_html_() in html
    assert evaluation._repr_html_() in html

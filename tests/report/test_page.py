"""The report of whole, partial and hostile runs, and as a browser shows it."""

import dataclasses
import math
import re

import numpy as np
import pytest
import torch

from browser import hindrances, opened, until
from pages import HOSTILE, Page
from roadproof.attacks import CMAES, AttackResult, Candidate
from roadproof.attacks.driven import Effect
from roadproof.attacks.result import Cost
from roadproof.coverage import Shape
from roadproof.datatypes import Ending
from roadproof.driving.evaluation import load_paint
from roadproof.driving.starts import StartOffset
from roadproof.errors import EpisodeError, RoadproofError
from roadproof.patterns import Pattern, save_pattern
from roadproof.pipeline.stage_costs import Ledger
from roadproof.report.page import _figures, write_report
from roadproof.report.verdict import _driven
from roadproof.simulators.protocol import PaintKind
from runs import CRASH, PATTERN, read_result, write_attack, write_evaluation, write_film, write_run, write_selection

SECTIONS = ("film", "above", "pattern", "conditions", "search", "calibration", "cost", "again")


def report_of(folder):
    return Page(write_report(folder).read_text(encoding="utf-8"))


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    folder = tmp_path_factory.mktemp("run")
    evaluation = write_run(folder, events=CRASH)
    write_report(folder)
    return folder, evaluation


def test_a_whole_run_has_every_section_and_leaves_nothing_out(run):
    page = Page((run[0] / "report.html").read_text())
    assert tuple(each["id"] for each in page.all("section")) == SECTIONS
    assert {each["href"] for each in page.all("a")} >= {f"#{name}" for name in SECTIONS}
    text = page.text
    for words in (
        "Fails over the paint",
        "collision static (tree 7)",
        "rainy noon",
        "20 cars and 20 people",
        "use more restarts",
        "perturbed less than asked",
        "1.40 m left",
        "45: too few points",
        "0.20 (0.40)",
    ):
        assert words in text
    assert "#e5cc1a" in text, "the paint's own colour"


def test_the_numbers_shown_are_those_of_the_evaluation(run):
    folder, evaluation = run
    content = read_result(folder)
    assert [trial["deviation_m"] for trial in content["closed_loop"]["trials"]] == [
        trial.deviation_m for trial in evaluation.trials
    ]
    assert content["surrogate"]["shift"] == 0.31
    calls = {each["stage"]: each["simulator_calls"] for each in content["cost"]}
    assert calls == {"record": 4, "calibrate": 6, "attack": 0, "evaluate": 12}
    assert not {"shift", "by_group"} & set(content["closed_loop"])
    text = Page((folder / "report.html").read_text()).text
    for row in evaluation.rows():
        assert f"{row.deviation_m.value:.2f}" in text
        assert f"{row.points.value:.1f}" in text
    # Four drives of eight penalty points each, by hand: wrong lane 2 and a tree 6; none on the bare road.
    assert "costs 8.0 ± 0.0 penalty points instead of 0.0 ± 0.0" in text


def test_the_costs_shown_are_those_of_the_ledger_where_there_is_one(tmp_path):
    write_run(tmp_path)
    ledger = Ledger(tmp_path, {"seed": 0}, ("record", "calibrate", "attack", "select", "rounds", "evaluate"))
    for stage, calls in {"record": 4, "calibrate": 6, "attack": 0, "select": 7, "evaluate": 12}.items():
        with ledger.stage(stage):
            ledger.calls(stage, calls)
    page = report_of(tmp_path)
    costs = read_result(tmp_path)["cost"]
    assert {each["stage"]: each["simulator_calls"] for each in costs} == {
        "record": 4, "calibrate": 6, "attack": 0, "select": 7, "evaluate": 12
    }  # fmt: skip
    assert all(each["seconds"] > 0 for each in costs)
    assert [each["frames"] for each in costs if each["stage"] == "attack"] != [None]
    assert "select 7" in page.text
    assert "Seconds are of the whole run" in page.text


def test_the_figures_listed_are_those_of_the_pattern_that_was_chosen(tmp_path):
    write_run(tmp_path)
    attack = tmp_path / "attack" / "pattern.json"
    save_pattern(dataclasses.replace(PATTERN, colours=PATTERN.colours.flip(0)), attack)
    assert "#e5cc1a" not in report_of(tmp_path).text, "the attack's strongest is not what was painted"
    save_pattern(PATTERN, tmp_path / "pattern.json")
    assert "#e5cc1a" in report_of(tmp_path).text


def test_figures_that_are_turned_have_their_size_and_angle_on_the_road():
    # Canvas pixels of 17.5 by 23.75 mm, worked out by hand; a diagonal of 300 by 300 pixels is 5.25 m by 7.125 m.
    boxes = [[200, 200, 40, 300, 0], [200, 200, 40, 300, 90], [200, 200, 40, 300, 45], [200, 200, 300, 40, -45]]
    pattern = Pattern((Shape.RECTANGLE,) * 4, torch.tensor(boxes, dtype=torch.float32), torch.zeros(4, 3))
    across, along = 40 * math.hypot(0.0175, 0.02375) / math.sqrt(2), 300 * math.hypot(0.0175, 0.02375) / math.sqrt(2)
    told = [(row["size"], row["turned"]) for row in _figures(pattern, (7.0, 9.5))]
    assert told == [
        ("0.70 × 7.12 m", "0°"),
        ("0.95 × 5.25 m", "90°"),
        (f"{across:.2f} × {along:.2f} m", "36°"),
        (f"{along:.2f} × {across:.2f} m", "-54°"),
    ]
    assert [row["size"] for row in _figures(pattern, None)][1] == "40 × 300 px"


def test_how_conspicuous_is_told_of_the_pattern_that_is_shown(tmp_path):
    write_run(tmp_path)
    told = []
    for pattern in (PATTERN, dataclasses.replace(PATTERN, colours=PATTERN.colours.flip(0))):
        save_pattern(pattern, tmp_path / "pattern.json")
        write_report(tmp_path)
        told.append(read_result(tmp_path)["conspicuousness"])
    assert told[0].keys() - told[1].keys() == {"the pattern"}


def test_every_candidate_that_was_driven_is_shown_and_the_one_that_was_kept(tmp_path):
    write_run(tmp_path)
    assert "Chosen by driving" not in report_of(tmp_path).text
    first = write_selection(tmp_path / "selection", 0.4, 0.9, chosen=1)
    again = write_selection(tmp_path / "round-1" / "selection", 1.3, 0.2, chosen=0)
    write_selection(tmp_path / "round-2" / "selection", 0.5, chosen=0)
    text = report_of(tmp_path).text
    for trial in (*first, *again):
        assert f"{trial.deviation_m:.2f} {abs(trial.lateral_m):.2f} 0" in text
    assert text.count(", chosen") == 1
    assert f"round 1, chosen clean+left 1 {again[0].deviation_m:.2f}" in text
    assert text.index("the search") < text.index("round 1") < text.index("round 2")


def test_a_damaged_choice_is_named(tmp_path):
    write_run(tmp_path)
    write_selection(tmp_path / "selection", 0.4, chosen=0)
    (tmp_path / "selection" / "selection.json").write_text('{"format": "roadproof-selection", "version": 1}')
    with pytest.raises(RoadproofError, match=r"selection\.json is incomplete or damaged"):
        write_report(tmp_path)


def test_the_page_needs_nothing_from_outside(run):
    page = Page((run[0] / "report.html").read_text())
    assert not page.all("script")
    assert not page.all("link") or all(each["href"].startswith("data:") for each in page.all("link"))
    for tag in ("img", "video", "source", "image"):
        for each in page.all(tag):
            for key in ("src", "poster", "href", "xlink:href"):
                assert each.get(key, "data:").startswith(("data:", "#"))
    assert "default-src 'none'" in page.all("meta")[2]["content"]


def test_pictures_have_words_and_tables_have_headers(run):
    page = Page((run[0] / "report.html").read_text())
    assert all(each.get("alt") for each in page.all("img"))
    drawn = page.all("svg")
    assert len(drawn) == 4
    assert all(each["role"] == "img" and each["aria-label"] for each in drawn)
    assert all(each.get("scope") in ("col", "row") for each in page.all("th"))
    ids = [attributes["id"] for _, attributes in page.tags if "id" in attributes]
    assert len(ids) == len(set(ids)), "no id twice, those inside the charts included"
    for each in page.all("use"):
        assert each["xlink:href"][1:] in ids


def test_the_same_run_gives_the_same_page(run):
    before = (run[0] / "report.html").read_bytes()
    write_report(run[0])
    assert (run[0] / "report.html").read_bytes() == before


def test_hostile_names_are_shown_and_do_nothing(tmp_path):
    # A scenario cannot be called so.
    write_run(tmp_path, controller=f"module:{HOSTILE}")
    (tmp_path / "commands.txt").write_text(f"roadproof evaluate {HOSTILE}\n")
    text = (write_report(tmp_path)).read_text(encoding="utf-8")
    page = Page(text)
    assert HOSTILE in page.text, "shown as it is"
    assert not page.all("script")
    assert not [each for each in page.all("img") if "onerror" in each or each["src"] == "x"]


@pytest.mark.parametrize("stage", ["attack", "evaluation", "record"])
def test_a_run_that_has_come_only_so_far_says_what_is_missing(tmp_path, stage):
    whole = tmp_path / "whole"
    write_run(whole)
    (tmp_path / "part").mkdir()
    (whole / stage).rename(tmp_path / "part" / stage)
    page = report_of(tmp_path / "part")
    assert tuple(each["id"] for each in page.all("section")) == SECTIONS
    content = read_result(tmp_path / "part")
    expected = {"attack": "predicted", "evaluation": "fails", "record": "recorded"}
    assert content["verdict"]["key"] in (expected[stage], "deviates")
    assert ("closed_loop" in content) == (stage == "evaluation")
    assert (content["surrogate"] is not None) == (stage == "attack")
    assert ("roadproof evaluate" in page.text) == (stage != "evaluation")


def test_an_attack_in_a_simulator_is_driven_to_choose_and_not_predicted(tmp_path):
    write_attack(tmp_path / "attack")
    found, effect = AttackResult.load(tmp_path / "attack"), Effect(0.4, 1.25)
    only = {"driven": effect, "surrogate_shift": None, "group": "all"}
    dataclasses.replace(
        found,
        **only,
        objective="path deviation",
        by_group={"all": 1.25},
        candidates=(Candidate(found.pattern, "all", driven=effect),),
        cost=Cost(controller_frames=900, seconds=31.0, simulator_calls=21),
        history=found.history[:, :1, :1],
        method=CMAES(calls=20),
    ).save(tmp_path / "attack")
    page, content = report_of(tmp_path), read_result(tmp_path)
    assert content["verdict"]["key"] == "chosen"
    assert "deviate by 1.25 m" in content["verdict"]["sentence"]
    assert content["surrogate"] is None and content["search"]["driven"]["deviation"] == 1.25
    assert [row["simulator_calls"] for row in content["cost"]] == [21]
    assert "Best path deviation, m in the drives that chose" in page.text
    assert "Predict" not in page.text and "composited" not in page.text


VERDICTS = {
    "fails": {"events": CRASH},
    "deviates": {"aside_m": 0.7},
    "holds": {"aside_m": 0.02},
    "unfit": {"events": CRASH, "clean_events": CRASH[:1]},
}


@pytest.mark.parametrize("key", VERDICTS)
def test_the_verdict_follows_from_the_drives(tmp_path, key):
    write_evaluation(tmp_path / "evaluation", runs=0, **VERDICTS[key])
    report_of(tmp_path)
    assert read_result(tmp_path)["verdict"]["key"] == key


@pytest.mark.parametrize(
    ("endings", "title"),
    [
        ((Ending.GOAL_REACHED, Ending.GOAL_REACHED), "Holds its lane"),
        ((Ending.GOAL_REACHED, Ending.BLOCKED), "Stops over the paint"),
        ((Ending.BLOCKED, Ending.BLOCKED), "Fails without paint"),
        (("", Ending.BLOCKED), "Holds its lane"),  # in files of earlier versions nobody said
    ],
)
def test_a_car_that_stops_does_not_hold_its_lane(tmp_path, endings, title):
    evaluation = write_evaluation(tmp_path / "evaluation", runs=0, aside_m=0.02)
    clean, painted = map(str, endings)
    trials = [dataclasses.replace(each, clean_ending=clean, ending=painted) for each in evaluation.trials]
    assert _driven(dataclasses.replace(evaluation, trials=tuple(trials))).title == title


def test_a_car_that_stops_is_told_of_the_drives_that_arrive_without_paint(tmp_path):
    evaluation = write_evaluation(tmp_path / "evaluation", runs=0, aside_m=0.02)
    arrived, blocked = str(Ending.GOAL_REACHED), str(Ending.BLOCKED)
    endings = [(arrived, blocked), (arrived, arrived), (arrived, arrived), (blocked, blocked)]
    trials = [
        dataclasses.replace(each, start=StartOffset(right_m=0.01 * k), clean_ending=clean, ending=painted)
        for k, (each, (clean, painted)) in enumerate(zip(evaluation.trials * 2, endings, strict=True))
    ]
    told = _driven(dataclasses.replace(evaluation, trials=tuple(trials), starts=2))
    assert "does not arrive in 1 of 3 drives alone" in told.sentence


@pytest.mark.parametrize(("failing", "key"), [(1, "holds"), (2, "holds"), (3, "unfit"), (4, "unfit")])
def test_a_controller_is_unfit_that_fails_in_most_drives_over_the_bare_road(tmp_path, failing, key):
    evaluation = write_evaluation(tmp_path / "evaluation", runs=0, aside_m=0.02)
    trials = [
        dataclasses.replace(each, start=StartOffset(right_m=0.01 * k), points=points, clean_points=points)
        for k, each in enumerate(evaluation.trials * 2)
        for points in [2.0 * (k < failing)]
    ]
    assert len(trials) == 4
    judged = dataclasses.replace(evaluation, trials=tuple(trials), starts=2)
    assert _driven(judged).key == key


def test_another_simulators_map_leaves_the_road_out_of_the_picture(tmp_path):
    evaluation = write_evaluation(tmp_path / "evaluation", runs=0)
    with_road = len(write_report(tmp_path).read_text())
    toml = tmp_path / "evaluation" / "scenario.toml"
    toml.write_text(toml.read_text().replace(f'"{evaluation.scenario.map_name}"', '"Town10HD"'))
    page = write_report(tmp_path).read_text()
    assert len(page) < with_road
    assert "From above" in page


def test_what_cannot_be_reported_is_refused(tmp_path):
    with pytest.raises(RoadproofError, match="no folder"):
        write_report(tmp_path / "nowhere")
    with pytest.raises(RoadproofError, match="nothing to report yet"):
        write_report(tmp_path)
    write_attack(tmp_path / "attack")
    (tmp_path / "evaluation").mkdir()
    (tmp_path / "evaluation" / "evaluation.json").write_text("{}")
    with pytest.raises(EpisodeError, match=r"evaluation\.json has format None"):
        write_report(tmp_path)
    assert not (tmp_path / "report.html").exists()


def luminance(colour):
    channels = [int(colour[k : k + 2], 16) / 255 for k in (1, 3, 5)]
    linear = [c / 12.92 if c <= 0.03928 else ((c + 0.055) / 1.055) ** 2.4 for c in channels]
    return float(np.dot([0.2126, 0.7152, 0.0722], linear))


def contrast(one, two):
    high, low = sorted((luminance(one), luminance(two)), reverse=True)
    return (high + 0.05) / (low + 0.05)


def test_text_has_the_contrast_that_wcag_asks_for(run):
    style = (run[0] / "report.html").read_text()
    by_theme = [
        dict(re.findall(r"--([\w-]+): (#[0-9a-f]{6})", block)) for block in re.findall(r":root \{.*?\}", style, re.S)
    ]
    assert contrast("#000000", "#ffffff") == pytest.approx(21.0)
    for theme in by_theme[:2]:
        for ground in ("paper", "card"):
            for ink in ("ink", "muted", "clean", "painted", "predicted", "third", "fourth", "bad", "good"):
                assert contrast(theme[ink], theme[ground]) >= 4.5, (ink, ground)
        for kind in ("bad", "mid", "good"):
            assert contrast(theme[kind], theme[f"{kind}-soft"]) >= 4.5, kind


@pytest.mark.parametrize(
    ("paint", "words"),
    [
        (PaintKind.RENDERED, "rendered with the road"),
        (PaintKind.INJECT, "(paint: inject)"),
        (PaintKind.NATIVE, "(paint: native)"),
    ],
)
def test_the_page_and_its_numbers_say_how_paint_was_put_on_the_road(tmp_path, paint, words):
    evaluation = write_run(tmp_path)
    folder = tmp_path / "evaluation"
    dataclasses.replace(evaluation, paint=paint).save(folder, load_paint(folder))
    page = write_report(tmp_path).read_text()
    assert words in page
    assert read_result(tmp_path)["closed_loop"]["paint"] == paint


@pytest.mark.slow
def test_a_browser_shows_everything_and_has_nothing_to_complain_about(tmp_path):
    evaluation = write_run(tmp_path, events=CRASH)
    write_film(tmp_path / "evaluation")
    with opened(write_report(tmp_path)) as (page, complaints):
        for width, theme in ((1280, "light"), (390, "dark")):
            page.set_viewport_size({"width": width, "height": 900})
            page.emulate_media(color_scheme=theme)
            assert page.evaluate("document.documentElement.scrollWidth <= innerWidth"), "nothing sticks out to the side"
            assert page.evaluate("[...document.querySelectorAll('svg text')].every(t => t.getBBox().height >= 8)")
        pictures = page.evaluate("[...document.images].map(each => each.complete && each.naturalWidth > 0)")
        assert len(pictures) == 1 + 2 * 6
        assert all(pictures)
        charts = page.evaluate("[...document.querySelectorAll('svg')].map(each => each.getBoundingClientRect().height)")
        assert len(charts) == 4
        assert min(charts) > 150
        rows = page.evaluate("document.querySelectorAll('#closed-loop tbody tr').length")
        assert rows == len(evaluation.rows()) == 6
        until(page, "document.querySelector('video').readyState >= 2")
        page.evaluate("document.querySelector('video').currentTime = 0.8")
        until(page, "!document.querySelector('video').seeking")
        film = page.evaluate(
            "(v => [v.error, v.videoWidth, v.duration, v.currentTime])(document.querySelector('video'))"
        )
        assert film == [None, 1280, pytest.approx(1.2, abs=0.1), pytest.approx(0.8)]
        assert complaints == []


@pytest.mark.slow
def test_nothing_on_the_page_keeps_anybody_out(tmp_path):
    write_run(tmp_path, events=CRASH)
    write_film(tmp_path / "evaluation")
    assert hindrances(write_report(tmp_path)) == []


@pytest.mark.slow
def test_one_moment_of_the_passage_is_shown_at_a_time_and_keys_and_pointer_move_through_them(tmp_path):
    write_run(tmp_path)
    shown = "[...document.querySelectorAll('.at')].filter(e => getComputedStyle(e).display != 'none')"
    moments = f"[...new Set({shown}.map(e => e.classList[1]))]"
    with opened(write_report(tmp_path)) as (page, complaints):
        assert page.evaluate(moments) == ["m3"], "pictures and the marks in every chart"
        assert page.evaluate(f"{shown}.length") == 1 + 2 + 1 + 2, "pictures, from above, offset, steering"
        page.focus("#moment-3")
        for key, expected in (("ArrowRight", "m4"), ("ArrowRight", "m5"), ("ArrowLeft", "m4")):
            page.keyboard.press(key)
            assert page.evaluate(moments) == [expected]
        before = page.locator("circle.at.m4.painted").first.bounding_box()
        page.hover(".dial .t1")
        assert page.evaluate(moments) == ["m1"], "where the pointer is, without pressing"
        assert page.locator("circle.at.m1.painted").first.bounding_box() != before
        page.mouse.move(0, 0)
        assert page.evaluate(moments) == ["m4"]
        page.emulate_media(media="print")
        assert page.evaluate(moments) == [f"m{k}" for k in range(6)], "paper shows some of them, here all"
        assert page.evaluate(f"{shown}.every(e => e.tagName == 'LI')")
        assert complaints == []


@pytest.mark.slow
def test_a_browser_does_not_run_hostile_names(tmp_path):
    write_run(tmp_path, controller=HOSTILE)
    with opened(write_report(tmp_path)) as (page, complaints):
        assert HOSTILE in page.inner_text("body")
        assert page.evaluate("document.scripts.length") == 0
        assert complaints == []

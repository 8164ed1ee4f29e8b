"""Runs beside each other: their numbers, and what is said where they are not alike."""

import dataclasses
from pathlib import Path

import pytest

from browser import hindrances
from command import answered, roadproof
from pages import HOSTILE, Page
from roadproof.errors import RoadproofError
from roadproof.patterns import raster
from roadproof.report.comparison import _cautions, _name, compared, write_comparison
from roadproof.report.page import result_of
from roadproof.report.run import read_run
from roadproof.scenarios import find_scenario
from roadproof.simulators.protocol import PaintKind
from runs import CRASH, PATTERN, write_run


@pytest.fixture(scope="module")
def runs(tmp_path_factory):
    folder = tmp_path_factory.mktemp("runs")
    write_run(folder / "before", aside_m=1.5, events=CRASH)
    write_run(folder / "after", aside_m=0.4)
    return folder / "before", folder / "after"


def test_the_change_is_drive_by_drive(runs):
    before, after = compared(runs)
    assert (before.name, after.name) == ("before", "after")
    assert before.change is None
    trials = [each.judged.evaluation.of(traffic=False) for each in (before, after)]
    differences = [two.deviation_m - one.deviation_m for one, two in zip(*trials, strict=True)]
    assert after.change.value == pytest.approx(sum(differences) / len(differences))
    assert after.change.value < -0.1
    assert after.change.count == len({trial.start for trial in trials[0]}), "a start in two weathers is one run"


def test_the_page_shows_both_and_needs_nothing_else(runs, tmp_path):
    write_comparison(runs, tmp_path / "compare.html")
    text = (tmp_path / "compare.html").read_text()
    page = Page(text)
    assert "driven, m" in page.text
    assert "predicted, m" not in page.text
    assert all(each["src"].startswith("data:") for each in page.all("img"))
    names = [each["id"] for _, each in page.tags if "id" in each]
    assert len(names) == len(set(names)), "charts share no names"
    assert {"runs", "weathers", "offsets", "patterns"} <= set(names)
    assert write_comparison(runs, tmp_path / "again.html")
    assert (tmp_path / "again.html").read_text() == text


@pytest.mark.slow
def test_nothing_on_the_page_keeps_anybody_out(runs, tmp_path):
    write_comparison(runs, tmp_path / "compare.html")
    assert hindrances(tmp_path / "compare.html") == []


def test_what_is_not_alike_is_said(runs, tmp_path):
    write_run(tmp_path / "elsewhere", scenario=find_scenario("straight-02"))
    write_comparison([runs[0], tmp_path / "elsewhere"], tmp_path / "compare.html")
    page = Page((tmp_path / "compare.html").read_text())
    assert "different stretches of road" in page.text
    assert compared([runs[0], tmp_path / "elsewhere"])[1].change is None
    assert "offsets" not in [each["id"] for _, each in page.tags if "id" in each]


def test_another_pattern_is_said_however_many_were_judged_over_it(runs, tmp_path):
    other = dataclasses.replace(PATTERN, colours=PATTERN.colours.flip(0))
    for name, pattern in (("again", PATTERN), ("other", other)):
        evaluation = write_run(tmp_path / name)
        evaluation.save(tmp_path / name / "evaluation", raster(pattern))
    said = "They were not all judged over the same pattern."
    for names, own, some in ((["again"], 0, 0), (["other"], 1, 0), (["again", "other"], 0, 1)):
        told = _cautions(compared([runs[1], *(tmp_path / name for name in names)]), same_place=True)
        assert (told.count("Each was judged over a pattern of its own."), told.count(said)) == (own, some)


def test_others_in_other_numbers_are_said(runs, tmp_path):
    said = "with the same others on the road"
    for name, cars in (("few", 20), ("again", 20), ("many", 200)):
        made = dataclasses.replace(write_run(tmp_path / name), cars=cars)
        assert made.of(traffic=True)
        made.save(tmp_path / name / "evaluation", raster(PATTERN))
    for other, differ in (("again", False), ("many", True)):
        write_comparison([tmp_path / "few", tmp_path / other], tmp_path / "compare.html")
        assert (said in (tmp_path / "compare.html").read_text()) is differ


def write_predicted(folder):
    evaluation = dataclasses.replace(write_run(folder), paint=PaintKind.COMPOSITED)
    evaluation.save(folder / "evaluation", raster(PATTERN))


def test_driven_and_predicted_never_share_a_column(runs, tmp_path):
    write_predicted(tmp_path / "predicted")
    write_comparison([runs[0], tmp_path / "predicted"], tmp_path / "compare.html")
    page = Page((tmp_path / "compare.html").read_text())
    assert "driven, m" in page.text
    assert "predicted, m" in page.text
    assert "not of one kind" in page.text
    assert page.text.count("leave the lane") == 2 and "leave the lane, predicted" in page.text


def test_names_from_files_are_escaped(tmp_path):
    for name in ("one", "two"):
        write_run(tmp_path / name, controller=HOSTILE)
    write_comparison([tmp_path / "one", tmp_path / "two"], tmp_path / "compare.html")
    assert "<script" not in (tmp_path / "compare.html").read_text()


def test_what_cannot_be_compared_is_refused(runs, tmp_path):
    with pytest.raises(RoadproofError, match="1 runs to compare, expected 2 to 8"):
        compared(runs[:1])
    with pytest.raises(RoadproofError, match="given twice"):
        compared([runs[0], runs[0]])
    with pytest.raises(RoadproofError, match="no folder"):
        compared([runs[0], tmp_path / "none"])
    done = roadproof("compare", runs[0], tmp_path, "--out", tmp_path / "page.html")
    assert done.returncode == 2
    assert len(done.stderr.splitlines()) == 1
    assert not (tmp_path / "page.html").exists()


def test_the_command_shows_a_table(runs, tmp_path):
    done = roadproof("compare", *runs, "--out", tmp_path / "deep" / "page.html")
    assert done.returncode == 0, done.stderr
    assert "change m" in done.stdout
    assert (tmp_path / "deep" / "page.html").exists()


def test_the_command_answers_programs_with_what_result_json_says(runs, tmp_path, invoke):
    write_predicted(tmp_path / "predicted")
    code, printed = invoke("compare", *runs, tmp_path / "predicted", "--out", tmp_path / "page.html", "--json")
    assert (code, printed.err) == (0, "")
    told = answered(printed.out)["runs"]
    for run, one in zip(runs, told, strict=False):
        kept = result_of(read_run(run))["closed_loop"]
        rows = [row for row in kept["rows"] if not row["traffic"]]
        assert [row["median_m"] for row in one["closed_loop"]["rows"]] == [row["median_m"] for row in rows]
    assert (
        ["predicted" in each for each in told] == ["closed_loop" not in each for each in told] == [False, False, True]
    )
    assert told[1]["closed_loop"]["change_m"]["value"] < -0.1
    # What is driven is not compared with what is predicted.
    assert told[2]["predicted"]["change_m"] is None


def test_runs_are_called_by_what_tells_them_apart():
    paths = [Path(each) for each in ("/a/one/left-03", "/b/one/left-03", "/b/two/right-05", "/left-03")]
    assert [_name(path, paths) for path in paths] == ["a/one/left-03", "b/one/left-03", "right-05", "/left-03"]

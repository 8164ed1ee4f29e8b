"""The files of a made-up study, and of hostile and broken ones."""

import json
import re
import shutil

import numpy as np
import pytest
from PIL import Image

from made_up_study import METHODS, made_up_study, write_made_up_study
from roadproof.errors import PatternError, StudyError
from roadproof.report.study.folder import read_found
from roadproof.report.study.page import write_study
from roadproof.report.study.results import JobId
from roadproof.study.methods import BlackBoxPlan

HOSTILE = "<b>_all_ 100% $x"


@pytest.fixture(scope="module")
def finished(tmp_path_factory):
    """Folder, rows and page of a study with a failed job and a hostile name."""
    folder = tmp_path_factory.mktemp("study")
    whole = made_up_study()
    methods = (METHODS[0], METHODS[3], BlackBoxPlan(name=HOSTILE, search="random", calls=20))
    study = made_up_study(
        scenarios=(whole.scenarios[0], whole.scenarios[3], whole.scenarios[4]), figures=("1-b", 3), methods=methods
    )
    frame = write_made_up_study(folder, study, failing={(study.scenarios[1].name, 3, "BO")})
    records = frame.to_dict("records")
    return folder, records, write_study(records, folder, folder / "tables")


def test_every_file_is_there(finished):
    folder, _, page = finished
    assert page == folder / "tables" / "tables.html"
    names = {
        path.relative_to(folder / "tables").as_posix() for path in (folder / "tables").rglob("*") if path.is_file()
    }
    assert {"tables.html", "tables.md", "overall-bo.tex", "missing.tex"} <= names
    drawn = ("by-figures", "progress", "trajectories", "patterns", "weathers")
    assert {f"figures/{name}.png" for name in drawn} <= names
    for name in names:
        if name.endswith(".png"):
            with Image.open(folder / "tables" / name) as drawn:
                assert min(drawn.size) > 200


def test_the_page_escapes_and_needs_nothing_else(finished):
    page = finished[2].read_text()
    assert "<b>_all_" not in page
    assert "&lt;b&gt;_all_ 100% $x" in page
    assert not re.search(r"<script|src=\"(?!data:)|https?://(?!www\.w3\.org)", page)
    assert page.count("<table") == page.count("</table>") > 8
    assert page.count("data:image/png;base64,") == 5


def test_what_failed_is_in_every_kind_of_file(finished):
    folder = finished[2].parent
    for name in ("tables.html", "tables.md", "overall-bo.tex", "missing.tex"):
        assert "its process died" in (folder / name).read_text(), name
    assert "17 of 18" in finished[2].read_text()


def test_the_same_rows_give_the_same_tables(finished, tmp_path):
    folder, records, page = finished
    again = write_study(records, folder, tmp_path)
    assert (tmp_path / "tables.md").read_text() == (page.parent / "tables.md").read_text()
    assert again.read_text() == page.read_text()


def test_a_list_of_gaps_goes_when_they_are_filled(tmp_path):
    study = made_up_study(scenarios=made_up_study().scenarios[:2], figures=(1,), methods=(METHODS[0], METHODS[3]))
    for failing in ({(study.scenarios[1].name, 1, "BO")}, set()):
        frame = write_made_up_study(tmp_path, study, failing=failing)
        page = write_study(frame.to_dict("records"), tmp_path, tmp_path / "tables")
        assert page.with_name("missing.tex").exists() == bool(failing)


def test_a_weather_never_names_a_file_elsewhere(finished):
    folder, records, _ = finished
    job = next(each for each in read_found(folder, records).values() if each.view("clear-noon") is not None)
    assert (job.view("rainy-noon"), job.view("hard-rain-noon")) == (pytest.approx(180, abs=3), None)
    other = next(each for each in job.folder.parent.iterdir() if each != job.folder)
    (job.folder / "view-").mkdir()
    assert job.view(f"/../../{other.name}/view-clear-noon") is None


def test_a_weather_of_the_rows_never_names_a_table_elsewhere(finished, tmp_path):
    folder, records, _ = finished
    moved = [{**row, "weather": str(row["weather"]).replace("rainy-noon", "../../up/rain")} for row in records]
    write_study(moved, folder, tmp_path / "study" / "tables")
    assert [path.name for path in tmp_path.iterdir()] == ["study"]
    assert [path.name for path in (tmp_path / "study").iterdir()] == ["tables"]
    assert (tmp_path / "study" / "tables" / "up-rain-alone-bo.tex").exists()


def test_a_damaged_view_is_named(finished, tmp_path):
    folder, records, _ = finished
    shutil.copytree(folder / "jobs", tmp_path / "jobs")
    job = next(each for each in read_found(tmp_path, records).values() if each.view("clear-noon") is not None)
    (job.folder / "view-clear-noon.jpg").write_bytes(b"no picture")
    with pytest.raises(StudyError, match=r"view-clear-noon\.jpg cannot be read"):
        job.view("clear-noon")


def test_a_folder_of_an_older_plan_is_not_taken(finished, tmp_path):
    folder, records, _ = finished
    shutil.copytree(folder / "jobs", tmp_path / "jobs")
    found = read_found(folder, records)
    assert len(found) == 18
    job, kept = next((job, each) for job, each in found.items() if each.paths() is not None)
    older = tmp_path / "jobs" / "zzzz"
    shutil.copytree(kept.folder, older)
    rows = json.loads((older / "rows.json").read_text())
    rows["rows"][0]["deviation_m"] += 1.0
    (older / "rows.json").write_text(json.dumps(rows))
    assert read_found(tmp_path, records)[job].folder == tmp_path / "jobs" / kept.folder.name


def test_pictures_need_no_files_of_jobs(finished, tmp_path):
    _, records, _ = finished
    page = write_study(records, tmp_path, tmp_path / "out")
    assert [path.name for path in (tmp_path / "out" / "figures").iterdir()] == ["by-figures.png"]
    assert page.exists()


@pytest.mark.parametrize(
    ("name", "content", "error", "message"),
    [
        ("paths.npz", b"no zip", StudyError, "paths.npz is damaged"),
        ("history.json", b"{}", StudyError, "history.json has format None"),
        ("job.json", b"[]", StudyError, "job.json is damaged"),
        ("pattern.json", b"{}", PatternError, "pattern.json has format None"),
    ],
)
def test_damaged_files_are_named(finished, tmp_path, name, content, error, message):
    folder, records, _ = finished
    shutil.copytree(folder / "jobs", tmp_path / "jobs")
    found = read_found(tmp_path, records)
    job = next(each for each in found.values() if each.job.method == "BO" and (each.folder / "paths.npz").exists())
    (job.folder / name).write_bytes(content)
    with pytest.raises(error, match=message):
        again = read_found(tmp_path, records)[job.job]
        again.paths(), again.history(), again.pattern()


def test_paths_that_are_no_paths_are_named(finished, tmp_path):
    folder, records, _ = finished
    shutil.copytree(folder / "jobs", tmp_path / "jobs")
    found = read_found(tmp_path, records)
    job = next(iter(found))
    np.savez(found[job].folder / "paths.npz", clean_xy=np.zeros((3, 3)), painted_xy=np.zeros((2, 2)))
    with pytest.raises(StudyError, match=r"holds \(3, 3\), expected finite x, y"):
        found[job].paths()


def test_a_job_that_failed_has_a_folder_without_files(finished):
    folder, records, _ = finished
    failing = next(row for row in records if isinstance(row["error"], str))
    found = read_found(folder, records)[JobId(failing["scenario"], "3", "BO", 0)]
    assert (found.paths(), found.pattern(), found.history()) == (None, None, None)


@pytest.mark.parametrize(
    ("content", "expected"),
    [
        # The surrogate's own values are never taken for driven ones.
        ({"kind": "surrogate", "calls": [9, 9], "seconds": [1, 2], "best": [5.0, 7.0]}, None),
        (
            {"kind": "surrogate", "calls": [9], "seconds": [1], "best": [7.0],
             "driven": {"calls": [15], "seconds": [60.0], "best": [1.5]}},
            ([15.0], [60.0], [1.5]),
        ),
        (
            {"kind": "closed loop", "calls": [2, 3], "seconds": [1, 2], "best": [4.0, 7.0], "deviation_m": [0.2, 0.1]},
            ([2.0, 3.0], [1.0, 2.0], [0.2, 0.1]),
        ),
    ],
)  # fmt: skip
def test_a_history_is_of_driving_alone(finished, tmp_path, content, expected):
    folder, records, _ = finished
    shutil.copytree(folder / "jobs", tmp_path / "jobs")
    job = next(iter(read_found(tmp_path, records).values()))
    stated = {"format": "roadproof-study-history", "version": 1} | content
    (job.folder / "history.json").write_text(json.dumps(stated))
    history = job.history()
    if expected is None:
        assert history is None
    else:
        assert (history.calls.tolist(), history.seconds.tolist(), history.deviation_m.tolist()) == expected


def test_transfer_has_its_matrix_in_the_page(finished, tmp_path):
    _, records, _ = finished
    rows = [
        {**row, "found_on": "cil", "driven_by": driver}
        for row in records
        for driver in ("cil", "pilotnet")
        if not isinstance(row["error"], str)
    ]
    page = write_study(records, tmp_path, tmp_path / "out", rows)
    assert "driven by" in page.read_text()
    assert (tmp_path / "out" / "figures" / "transfer-deviation.png").exists()
    assert (tmp_path / "out" / "transfer-deviation.tex").exists()

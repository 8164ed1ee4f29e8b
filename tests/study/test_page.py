"""The files of a made-up study, and of hostile and broken ones."""

import json
import re
import shutil
from pathlib import Path

import numpy as np
import pytest
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from pandas import concat
from PIL import Image

from browser import hindrances
from made_up_study import METHODS, made_up_study, write_made_up_study
from roadproof.errors import PatternError, StudyError
from roadproof.study import charts
from roadproof.study.folder import write_table
from roadproof.study.kept_jobs import read_jobs
from roadproof.study.methods import BlackBoxPlan
from roadproof.study.page import write_tables
from roadproof.study.paper_tables import paper_tables
from roadproof.study.plan import load_study
from roadproof.study.results import results_of
from roadproof.study.rows import JobId

STUDIES = Path(__file__).parents[2] / "studies"
HOSTILE = "<b>_all_ 100% $x"


def finished_study():
    """With a hostile name."""
    whole = made_up_study()
    methods = (METHODS[0], METHODS[3], BlackBoxPlan(name=HOSTILE, search="random", calls=20))
    scenarios = (whole.scenarios[0], whole.scenarios[3], whole.scenarios[4])
    return made_up_study(scenarios=scenarios, figures=("1-b", 3), methods=methods)


@pytest.fixture(scope="module")
def finished(tmp_path_factory):
    """Folder, rows and page of a study with a failed job and a hostile name."""
    folder, study = tmp_path_factory.mktemp("study"), finished_study()
    frame = write_made_up_study(folder, study, failing={(study.scenarios[1].name, 3, "BO")})
    return folder, frame, write_tables(frame, folder, folder / "tables")


def test_every_file_is_there(finished):
    folder, _, page = finished
    assert page == folder / "tables" / "tables.html"
    names = {
        path.relative_to(folder / "tables").as_posix() for path in (folder / "tables").rglob("*") if path.is_file()
    }
    assert {"tables.html", "tables.md", "overall-bo.tex", "missing.tex"} <= names
    drawn = ("by-figures", "progress", "trajectories", "patterns", "passage-straight", "passage-left")
    assert {f"figures/{name}.png" for name in drawn} <= names
    for name in names:
        if name.endswith(".png"):
            with Image.open(folder / "tables" / name) as drawn:
                assert min(drawn.size) > 200


@pytest.mark.slow
def test_nothing_on_the_page_keeps_anybody_out(finished):
    assert hindrances(finished[2]) == []


def test_the_page_escapes_and_needs_nothing_else(finished):
    page = finished[2].read_text()
    assert "<b>_all_" not in page
    assert "&lt;b&gt;_all_ 100% $x" in page
    assert not re.search(r"<script|src=\"(?!data:)|https?://(?!www\.w3\.org)", page)
    assert page.count("<table") == page.count("</table>") > 8
    assert page.count("data:image/png;base64,") == 6


def test_what_failed_is_in_every_kind_of_file(finished):
    folder = finished[2].parent
    for name in ("tables.html", "tables.md", "overall-bo.tex", "missing.tex"):
        assert "its process died" in (folder / name).read_text(), name
    assert "17 of 18" in finished[2].read_text()


def test_the_same_rows_give_the_same_tables(finished, tmp_path):
    folder, rows, page = finished
    again = write_tables(rows, folder, tmp_path)
    assert (tmp_path / "tables.md").read_text() == (page.parent / "tables.md").read_text()
    assert again.read_text() == page.read_text()


def test_a_list_of_gaps_goes_when_they_are_filled(tmp_path):
    study = made_up_study(scenarios=made_up_study().scenarios[:2], figures=(1,), methods=(METHODS[0], METHODS[3]))
    for failing in ({(study.scenarios[1].name, 1, "BO")}, set()):
        frame = write_made_up_study(tmp_path, study, failing=failing)
        page = write_tables(frame, tmp_path, tmp_path / "tables")
        assert page.with_name("missing.tex").exists() == bool(failing)


def read_again(folder, methods):
    """The numbers of a made-up study of some methods, with what its folder says of them."""
    study = made_up_study(scenarios=made_up_study().scenarios[:1], figures=(1,), methods=methods)
    rows = write_made_up_study(folder, study)
    return results_of(rows, [job.method for job in read_jobs(folder, rows).values()])


def test_gradopt_with_another_objective_is_a_rival_and_no_ablation(tmp_path):
    methods = load_study(STUDIES / "searches.toml").methods[:3]
    found = read_again(tmp_path, methods)
    assert (found.reference.name, found.ablation) == ("GradOpt, steering shift", ())
    assert found.compared == ["GradOpt, steering shift", "GradOpt", "random"]
    assert not any(table.name.startswith("ablation") for table in paper_tables(found))


def test_gradopt_with_other_recordings_has_the_ablation(tmp_path):
    methods = load_study(STUDIES / "ablation.toml").methods
    found = read_again(tmp_path, (*methods, METHODS[4]))
    assert found.reference.name == "Group T=3"
    assert [method.name for method in found.ablation] == [method.name for method in methods]
    assert found.compared == ["Group T=3", "TPE"], "noise is another recording too"
    (table, _) = (table for table in paper_tables(found) if table.name.startswith("ablation"))
    named = ["T=1", "Group T=3", "Group T=3, noise", "T=5", "T=7", "T=3", "T=5", "T=7", "T=3", "T=5", "T=7"]
    assert [heading.text for heading in table.header[1]] == ["K", *named]


def test_a_setting_that_older_jobs_lack_makes_no_difference(tmp_path):
    methods = METHODS[:2]
    study = made_up_study(scenarios=made_up_study().scenarios[:1], figures=(1,), methods=methods)
    rows = write_made_up_study(tmp_path, study)
    path = tmp_path / "jobs" / study.jobs[0].key / "job.json"
    told = json.loads(path.read_text())
    assert told["method"].pop("attack_weathers") == []
    path.write_text(json.dumps(told))
    one, other = (job.method for job in read_jobs(tmp_path, rows).values())
    assert one.searches_as(other)


def test_patterns_were_found_in_the_first_weather_of_the_plan_whatever_the_first_row_has(finished, tmp_path):
    folder, rows, page = finished
    told = page.with_name("overall-bo.tex").read_text()
    # As where the first job's drive over the bare road did not reach the canvas, and then those of all.
    first = (rows["weather"] == "clear-noon") & (rows["job"] == rows["job"].iloc[0])
    (tmp_path / "study").mkdir()
    (tmp_path / "study" / "jobs").symlink_to(folder / "jobs")
    write_tables(rows[~first], tmp_path / "study", tmp_path / "out")
    assert "all scenarios, clear noon" in told
    assert "all scenarios, clear noon" in (tmp_path / "out" / "overall-bo.tex").read_text()
    assert (tmp_path / "out" / "rainy-noon-alone-bo.tex").exists()
    none = write_tables(rows[rows["weather"] != "clear-noon"], tmp_path / "study", tmp_path / "none")
    assert "found at clear noon, judged also at cloudy noon, rainy noon" in none.with_name("tables.md").read_text()


def test_drives_that_all_jobs_lack_are_missing_too(finished, tmp_path):
    folder, rows, _ = finished
    (tmp_path / "study").mkdir()
    (tmp_path / "study" / "jobs").symlink_to(folder / "jobs")
    lost = (rows["weather"] == "rainy-noon") & ~rows["traffic"].fillna(value=False).astype(bool)
    page = write_tables(rows[~lost & rows["error"].isna()], tmp_path / "study", tmp_path / "out")
    assert "0 of 1 drives at rainy noon; left out where the drive over the bare road" in page.read_text()
    assert "1 failed or missing, 17 without some drives, listed below" in page.read_text()


def test_jobs_of_the_plan_that_have_no_row_yet_are_missing(finished, tmp_path):
    folder, rows, _ = finished
    whole = rows[rows["error"].isna()]
    asked = [JobId(*each) for each in whole[list(JobId._fields)].drop_duplicates().itertuples(index=False)]
    plan = {"format": "roadproof-study-run", "version": 1, "reference": None}
    for name, jobs in (
        ("whole", asked),
        ("begun", [*asked, JobId("left-39", "7", "CMA", 3)]),
        ("wrong", [["left-39"]]),
    ):
        (tmp_path / name).mkdir()
        (tmp_path / name / "jobs").symlink_to(folder / "jobs")
        (tmp_path / name / "study.json").write_text(json.dumps(plan | {"jobs": jobs}))
    assert "listed below" not in write_tables(whole, tmp_path / "whole", tmp_path / "out").read_text()
    page = write_tables(whole, tmp_path / "begun", tmp_path / "out").read_text()
    assert f"{len(asked)} of {len(asked) + 1}" in page
    assert "1 failed or missing, listed below" in page
    assert "no row; not done yet" in page
    with pytest.raises(StudyError, match=r"study\.json is damaged \(jobs: "):
        write_tables(whole, tmp_path / "wrong", tmp_path / "out")


def test_a_weather_never_names_a_file_elsewhere(finished):
    folder, rows, _ = finished
    job = next(
        each for each in read_jobs(folder, rows).values() if each.passage("clear-noon", traffic=False) is not None
    )
    assert job.passage("rainy-noon", traffic=False) == pytest.approx(180, abs=3)
    assert job.passage("hard-rain-noon", traffic=False) is None
    other = next(each for each in job.folder.parent.iterdir() if each != job.folder)
    (job.folder / "passage-").mkdir()
    assert job.passage(f"/../../{other.name}/passage-clear-noon", traffic=False) is None


def test_a_weather_of_the_rows_never_names_a_table_elsewhere(finished, tmp_path):
    folder, rows, _ = finished
    moved = rows.assign(weather=rows["weather"].str.replace("rainy-noon", "../../up/rain"))
    write_tables(moved, folder, tmp_path / "study" / "tables")
    assert [path.name for path in tmp_path.iterdir()] == ["study"]
    assert [path.name for path in (tmp_path / "study").iterdir()] == ["tables"]
    assert (tmp_path / "study" / "tables" / "up-rain-alone-bo.tex").exists()


def test_a_damaged_strip_is_named(finished, tmp_path):
    folder, rows, _ = finished
    shutil.copytree(folder / "jobs", tmp_path / "jobs")
    job = next(
        each for each in read_jobs(tmp_path, rows).values() if each.passage("clear-noon", traffic=False) is not None
    )
    (job.folder / "passage-clear-noon.jpg").write_bytes(b"no picture")
    with pytest.raises(StudyError, match=r"passage-clear-noon\.jpg cannot be read"):
        job.passage("clear-noon", traffic=False)


def test_a_folder_of_an_older_plan_is_not_taken(finished, tmp_path):
    folder, rows, _ = finished
    shutil.copytree(folder / "jobs", tmp_path / "jobs")
    found = read_jobs(folder, rows)
    assert len(found) == 18
    job, kept = next((job, each) for job, each in found.items() if each.paths() is not None)
    # The same names and the same numbers, but the key of other settings.
    for name in ("0000", "zzzz"):
        shutil.copytree(kept.folder, tmp_path / "jobs" / name)
    assert {each.folder for each in read_jobs(tmp_path, rows).values()} == {
        tmp_path / "jobs" / key for key in rows["job"]
    }
    assert read_jobs(tmp_path, rows)[job].folder == tmp_path / "jobs" / kept.folder.name


def test_rows_without_the_keys_of_their_jobs_are_refused_and_gathered_again(finished, tmp_path):
    folder, rows, page = finished
    shutil.copytree(folder / "jobs", tmp_path / "jobs")
    with pytest.raises(StudyError, match=r"do not say which job they belong to.*run the study again") as refused:
        write_tables(rows.drop(columns="job"), tmp_path, tmp_path / "tables")
    assert "\n" not in str(refused.value)
    assert not (tmp_path / "tables").exists()
    jobs = finished_study().jobs
    for job in jobs:
        path = tmp_path / "jobs" / job.key / "rows.json"
        old = json.loads(path.read_text())
        assert {row.pop("job") for row in old["rows"]} == {job.key}
        path.write_text(json.dumps(old))
    again = write_table(jobs, tmp_path)
    assert again.equals(rows)
    # Rows alone, as they are published, need no keys.
    (tmp_path / "alone").mkdir()
    write_tables(rows.drop(columns="job"), tmp_path / "alone", tmp_path / "out")
    assert (tmp_path / "out" / "overall-bo.tex").read_text() == (page.parent / "overall-bo.tex").read_text()


def test_keys_that_are_no_text_are_named(finished, tmp_path):
    folder, rows, _ = finished
    driven = rows[rows["error"].isna()].assign(found_on="cil")
    lists = [["a"]] * len(rows)
    for frame, transfer in ((rows.assign(job=lists), None), (rows, driven.assign(job=lists[: len(driven)]))):
        with pytest.raises(StudyError, match=r"job of the rows is \['a'\], expected text"):
            write_tables(frame, folder, tmp_path, transfer)


def test_a_key_never_names_a_folder_elsewhere(finished):
    folder, rows, _ = finished
    with pytest.raises(StudyError, match=r"job '\.\./jobs' is not a plain name"):
        read_jobs(folder, rows.assign(job="../jobs"))


def test_pictures_need_no_files_of_jobs(finished, tmp_path):
    _, rows, _ = finished
    page = write_tables(rows, tmp_path, tmp_path / "out")
    assert [path.name for path in (tmp_path / "out" / "figures").iterdir()] == ["by-figures.png"]
    assert page.exists()


@pytest.mark.parametrize(
    ("name", "content", "error", "message"),
    [
        ("paths.npz", b"no zip", StudyError, "paths.npz is damaged"),
        ("history.json", b"{}", StudyError, "history.json has format None"),
        (
            "history.json",
            b"""{"format": "roadproof-study-history", "version": 1, "kind": "closed loop", "calls": [1, 2],
            "seconds": [1, 2], "best": [1, 2], "deviation_m": [1]}""",
            StudyError,
            r"history.json is incomplete or damaged \(its deviation_m is not as long as its calls\)",
        ),
        ("job.json", b"[]", StudyError, "job.json is damaged"),
        (
            "job.json",
            b"""{"controller": "cil", "scenario": {"map_name": "town", "canvas": {"x_m": 0, "y_m": 0}},
            "method": {"name": "BO", "search": "gradopt", "scheme": "odd"}}""",
            StudyError,
            "job.json is damaged .*odd",
        ),
        (
            "job.json",
            b"""{"controller": "cil", "scenario": {"map_name": "town", "canvas": {"x_m": 0, "y_m": 0}},
            "method": {"name": "BO", "search": "gradopt", "scheme": "group", "attack_weathers": [1]}}""",
            StudyError,
            "job.json is damaged .*Expected `str`, got `int`",
        ),
        ("pattern.json", b"{}", PatternError, "pattern.json has format None"),
    ],
)
def test_damaged_files_are_named(finished, tmp_path, name, content, error, message):
    folder, rows, _ = finished
    shutil.copytree(folder / "jobs", tmp_path / "jobs")
    found = read_jobs(tmp_path, rows)
    job = next(each for each in found.values() if each.id.method == "BO" and (each.folder / "paths.npz").exists())
    (job.folder / name).write_bytes(content)
    with pytest.raises(error, match=message):
        again = read_jobs(tmp_path, rows)[job.id]
        again.paths(), again.deviation(), again.pattern()


def test_paths_that_are_no_paths_are_named(finished, tmp_path):
    folder, rows, _ = finished
    shutil.copytree(folder / "jobs", tmp_path / "jobs")
    found = read_jobs(tmp_path, rows)
    job = next(iter(found))
    np.savez(found[job].folder / "paths.npz", clean_xy=np.zeros((3, 3)), painted_xy=np.zeros((2, 2)))
    with pytest.raises(StudyError, match=r"holds \(3, 3\), expected finite x, y"):
        found[job].paths()


def test_a_job_that_failed_has_a_folder_without_files(finished):
    folder, rows, _ = finished
    failing = rows[rows["error"].notna()].iloc[0]
    found = read_jobs(folder, rows)[JobId(failing["scenario"], "3", "BO", 0)]
    assert (found.paths(), found.pattern(), found.deviation()) == (None, None, None)


@pytest.mark.parametrize(
    ("content", "expected"),
    [
        # What is shown on composited frames or predicted is never taken for driven.
        ({"kind": "surrogate", "calls": [9, 9], "seconds": [1, 2], "best": [5.0, 7.0]}, None),
        ({"kind": "predicted", "calls": [9, 9], "seconds": [1, 2], "best": [0.5, 0.7]}, None),
        (
            {"kind": "surrogate", "calls": [9], "seconds": [1], "best": [7.0],
             "driven": {"calls": [15], "seconds": [60.0], "best": [1.5]}},
            ((15,), (60.0,), (1.5,)),
        ),
        (
            {"kind": "closed loop", "calls": [2, 3], "seconds": [1, 2], "best": [4.0, 7.0], "deviation_m": [0.2, 0.1]},
            ((2, 3), (1.0, 2.0), (0.2, 0.1)),
        ),
    ],
)  # fmt: skip
def test_a_history_is_of_driving_alone(finished, tmp_path, content, expected):
    folder, rows, _ = finished
    shutil.copytree(folder / "jobs", tmp_path / "jobs")
    job = next(iter(read_jobs(tmp_path, rows).values()))
    stated = {"format": "roadproof-study-history", "version": 1} | content
    (job.folder / "history.json").write_text(json.dumps(stated))
    course = job.deviation()
    assert (None if course is None else (course.calls, course.seconds, course.best)) == expected


def test_a_search_that_no_drive_chose_from_is_a_hollow_point(finished):
    folder, rows, _ = finished
    results, jobs = results_of(rows), read_jobs(folder, rows)
    bo = {job for job in jobs if job.method == "BO"}
    picture = charts.progress(results, [jobs[job] for job in jobs if job not in bo])
    assert picture is not None
    points = {line.get_markerfacecolor(): line for line in picture.figure.axes[0].lines if line.get_marker() == "s"}
    assert set(points) == {"white"}
    drives = results.drives_of(results.overall[0], ["BO"], results.figures[0]).groupby(["scenario", "seed"])
    (point,) = points.values()
    assert point.get_xdata() == pytest.approx(drives["search_calls"].mean().median())
    assert point.get_ydata() == pytest.approx(drives["deviation_m"].mean().median())


def test_transfer_has_its_matrix_in_the_page(finished, tmp_path):
    _, rows, _ = finished
    driven = rows[rows["error"].isna()].assign(found_on="cil")
    both = concat([driven, driven.assign(controller="pilotnet")])
    page = write_tables(rows, tmp_path, tmp_path / "out", both)
    assert "driven by" in page.read_text()
    assert (tmp_path / "out" / "figures" / "transfer-deviation.png").exists()
    assert (tmp_path / "out" / "transfer-deviation.tex").exists()
    # A controller that never came to a canvas has no drive there: the other tables are there all the same.
    of_first = driven["scenario"] == driven["scenario"].iloc[0]
    apart = concat([driven[of_first], driven[~of_first].assign(controller="pilotnet")])
    text = write_tables(rows, tmp_path, tmp_path / "apart", apart).read_text()
    assert "The transfer is left out: none of its patterns was driven over by every controller." in text
    assert "driven by" not in text


def test_a_transfer_of_another_state_of_the_study_is_left_out(finished, tmp_path):
    _, rows, page = finished
    driven = rows[rows["error"].isna()].assign(found_on="cil")
    again = "Patterns that the study no longer has are left out; run the transfer again."
    lacking = f"{driven[driven['method'] == 'BO']['job'].nunique()} of the study&#39;s patterns are not in it"
    for of_now, shown in ((driven["method"] != "BO", True), (driven["method"] == "none", False)):
        out = tmp_path / str(shown)
        text = write_tables(rows, out, out, driven.assign(job=driven["job"].where(of_now, "0" * 16))).read_text()
        assert ("driven by" in text, again in text, lacking in text) == (shown, shown, shown)
        assert (out / "figures" / "transfer-deviation.png").exists() is shown
    whole = write_tables(rows, tmp_path, tmp_path / "whole", driven).read_text()
    assert "driven by" in whole
    assert again not in whole
    assert "are not in it" not in whole
    unjudged = write_tables(rows, tmp_path, tmp_path / "unjudged", driven[driven["method"] != "BO"]).read_text()
    assert (again in unjudged, lacking in unjudged) == (False, True)
    assert "driven by" not in page.read_text()


@pytest.mark.parametrize("width", [6.0, 10.0])
def test_a_legend_of_long_names_stays_inside_its_figure(width):
    figure = Figure(figsize=(width, 5.0), layout="constrained")
    axes = figure.add_subplot()
    for number in range(9):
        axes.plot([0, 1], [number, number], label=f"GradOpt, then CMA-ES {number}")
    charts.legend(figure)
    FigureCanvasAgg(figure).draw()
    (drawn,) = figure.legends
    extent = drawn.get_window_extent()
    assert 0 <= extent.x0 < extent.x1 <= figure.bbox.x1

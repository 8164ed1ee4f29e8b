from __future__ import annotations

import dataclasses
import shutil
from pathlib import Path

import numpy as np
import pytest

from roadproof.controllers import shipped
from roadproof.datatypes import Weather
from roadproof.driving.starts import StartPlan
from roadproof.errors import RoadproofError, StudyError
from roadproof.scenarios import builtin_scenarios
from roadproof.study.methods import BlackBoxPlan, GradOptPlan, PublishedPlan
from roadproof.study.plan import JOB_VERSIONS, TrafficPlan, load_study

TEXT = """
format = "roadproof-study"
version = 2
controller = "cil"
scenarios = ["left-0[12]", "straight-03"]
figures = ["1-b", 1, 5]
seeds = [0, 1]
weathers = ["clear-noon", "rainy-noon"]

[traffic]
runs = 4

[[method]]
name = "GradOpt"
search = "gradopt"
objective = "steering"
trajectories = 1

[[method]]
name = "BO"
search = "published-bo"
calls = 100
random_calls = 40
"""


@pytest.mark.parametrize("spec", ["own_driver_of_mine:make@FILE", "own_driver_of_mine:Driver.make"])
def test_hardened_weights_and_methods_of_a_class_are_known_by_their_files(tmp_path, monkeypatch, spec):
    monkeypatch.chdir(tmp_path)
    weights, source = tmp_path / "hardened.safetensors", tmp_path / "own_driver_of_mine.py"
    spec = spec.replace("FILE", str(weights))
    study = dataclasses.replace(load_study(written(tmp_path, TEXT)), controller=spec)
    keys = []
    for text, content in (("make = None", b"one"), ("make = 1", b"one"), ("make = 1", b"other")):
        source.write_text(text)
        weights.write_bytes(content)
        keys.append(study.jobs[0].key)
    assert len(set(keys)) == (3 if "@" in spec else 2)


ROOT = Path(__file__).parents[2]


def test_other_weights_of_a_shipped_controller_are_other_jobs(tmp_path, monkeypatch):
    study = dataclasses.replace(load_study(written(tmp_path, TEXT)), controller="pilotnet")
    folder = shutil.copytree(shipped.FOLDER, tmp_path / "assets")
    monkeypatch.setattr(shipped, "FOLDER", folder)
    before = study.jobs[0]
    shutil.copy(folder / "pilotnet-b.safetensors", folder / "pilotnet.safetensors")
    assert before.weights == ""
    assert study.jobs[0].weights == "8ad93a3836078ca6"
    assert study.jobs[0].key != before.key


def test_the_jobs_of_published_rows_keep_their_keys_with_the_weights_of_today(tmp_path):
    published = {path.name for path in (ROOT / "docs" / "results" / "small" / "jobs").iterdir()}
    assert published <= {job.key for job in load_study(ROOT / "studies" / "small.toml").jobs}
    study = load_study(written(tmp_path, TEXT))
    for name in shipped.shipped_names():
        (told,) = {job.weights for job in dataclasses.replace(study, controller=name).jobs}
        assert (told == "") is ("hardened" not in name), name  # these came after keys began to tell weights


def test_jobs_on_a_map_of_the_users_are_known_by_what_is_in_it_wherever_it_lies(tmp_path):
    job = load_study(written(tmp_path, TEXT)).jobs[0]
    keys = []
    for folder, content in (("one", "<OpenDRIVE/>"), ("two", "<OpenDRIVE/>"), ("two", "<OpenDRIVE />")):
        (tmp_path / folder).mkdir(exist_ok=True)
        own = tmp_path / folder / "own.xodr"
        own.write_text(content)
        keys.append(dataclasses.replace(job, scenario=dataclasses.replace(job.scenario, map_name=str(own))).key)
    assert keys[0] == keys[1] != keys[2]


def test_a_black_box_that_begins_with_gradopts_patterns_is_told_by_how_these_are_found(tmp_path, monkeypatch):
    job = load_study(written(tmp_path, TEXT)).jobs[0]
    alone, begun = (
        dataclasses.replace(job, method=BlackBoxPlan(name="BO", search="published-bo", start=start)) for start in (0, 6)
    )
    before = alone.key, begun.key
    monkeypatch.setitem(JOB_VERSIONS, "gradopt", 99)
    assert (alone.key == before[0], begun.key == before[1]) == (True, False)


def test_the_keys_of_jobs_stay_what_they_were():
    jobs = load_study(Path(__file__).parents[2] / "studies" / "small.toml").jobs
    assert (jobs[0].key, jobs[-1].key) == ("8ab07d5d14745fc2", "bae7e71332f47d46")


@pytest.mark.parametrize(
    ("before", "after", "message"),
    [
        ('controller = "cil"', 'controller = "evil:factory"', "'evil:factory' runs what its author wrote"),
        ('controller = "cil"', 'controller = "a.pt2"', "'a.pt2' runs what its author wrote"),
        ('controller = "cil"', 'controller = "cil"\nsimulator = "carla://example.org:2000"', "is another machine"),
    ],
)
def test_a_plan_that_runs_code_or_calls_out_is_followed_on_request_alone(tmp_path, before, after, message):
    path = written(tmp_path, TEXT.replace(before, after, 1))
    with pytest.raises(StudyError, match=message) as refused:
        load_study(path)
    assert "--trust" in str(refused.value)
    assert load_study(path, trust=True).jobs
    for harmless in ('controller = "cil:w.safetensors"', 'controller = "cil"\nsimulator = "carla://localhost:2000"'):
        assert load_study(written(tmp_path, TEXT.replace('controller = "cil"', harmless, 1)))


def written(tmp_path, text):
    path = tmp_path / "study.toml"
    path.write_text(text)
    return path


def test_a_study_says_what_it_compares(tmp_path):
    study = load_study(written(tmp_path, TEXT))
    assert [scenario.name for scenario in study.scenarios] == ["left-01", "left-02", "straight-03"]
    assert study.figures == ("1-b", 1, 5)
    assert study.weathers == (Weather.CLEAR_NOON, Weather.RAINY_NOON)
    assert (study.traffic.cars, study.traffic.runs) == (20, 4)
    assert (study.methods[0].trajectories, study.methods[1].calls) == (1, 100)
    assert len(study.jobs) == 3 * 3 * 2 * 2


def test_the_key_of_a_job_depends_on_all_that_it_does(tmp_path):
    study = load_study(written(tmp_path, TEXT))
    keys = [job.key for job in study.jobs]
    assert len(set(keys)) == len(keys)
    assert keys == [job.key for job in load_study(written(tmp_path, TEXT)).jobs]
    job = study.jobs[0]
    for change in (
        {"controller": "pilotnet"},
        {"seed": 7},
        {"weathers": (Weather.CLEAR_NOON,)},
        {"traffic": None},
        {"simulator": "carla://localhost"},
        {"method": dataclasses.replace(job.method, iterations=1)},
        {"method": dataclasses.replace(job.method, attack_weathers=(Weather.RAINY_NOON,))},
        {"scenario": dataclasses.replace(job.scenario, time_limit_s=1.0)},
    ):
        assert dataclasses.replace(job, **change).key != job.key


def test_other_weights_in_the_same_file_are_other_jobs(tmp_path):
    weights = tmp_path / "own.safetensors"
    study = dataclasses.replace(load_study(written(tmp_path, TEXT)), controller=f"cil:{weights}")
    nothing = [job.key for job in study.jobs]
    weights.write_bytes(b"one")
    first = [job.key for job in study.jobs]
    assert first == [job.key for job in study.jobs]
    weights.write_bytes(b"another")
    assert not {*nothing, *first} & {job.key for job in study.jobs}


@pytest.mark.parametrize("name", ["own.safetensors", "own.pt2"])
def test_another_card_beside_the_same_weights_is_another_job(tmp_path, name):
    weights, card = tmp_path / name, tmp_path / "own.json"
    study = dataclasses.replace(load_study(written(tmp_path, TEXT)), controller=str(weights))
    weights.write_bytes(b"one")
    keys = [study.jobs[0].key]
    for speed in (6.0, 7.0):
        card.write_text(f'{{"target_speed_mps": {speed}}}')
        keys.append(study.jobs[0].key)
    assert len(set(keys)) == 3
    named = dataclasses.replace(study, controller=f"pilotnet:{weights}").jobs[0].key
    card.unlink()
    assert study.jobs[0].key == keys[0]
    assert dataclasses.replace(study, controller=f"pilotnet:{weights}").jobs[0].key == named


def test_other_external_data_of_an_onnx_file_are_other_jobs(tmp_path):
    onnx = pytest.importorskip("onnx", reason="the extra onnx is not installed")
    network = tmp_path / "own.onnx"
    study = dataclasses.replace(load_study(written(tmp_path, TEXT)), controller=str(network))
    output = onnx.helper.make_tensor_value_info("w", onnx.TensorProto.FLOAT, [3])
    keys = []
    for weight in (1.0, -1.0):
        held = onnx.numpy_helper.from_array(np.full(3, weight, np.float32), "w")
        made = onnx.helper.make_model(onnx.helper.make_graph([], "graph", [], [output], [held]))
        (tmp_path / "weights.bin").unlink(missing_ok=True)
        onnx.save(made, network, save_as_external_data=True, location="weights.bin", size_threshold=0)
        keys += [(network.read_bytes(), study.jobs[0].key)]
    assert keys[0][0] == keys[1][0]
    assert keys[0][1] != keys[1][1]
    network.write_bytes(b"damaged")
    assert study.jobs[0].key not in dict(keys).values()


def test_a_function_whose_source_has_changed_is_another_controller(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    study = dataclasses.replace(load_study(written(tmp_path, TEXT)), controller="own_driver_of_mine:make")
    source = tmp_path / "own_driver_of_mine.py"
    keys = []
    for text in ("raise SystemExit('never imported')", "make = None", "make = None"):
        source.write_text(text)
        keys.append(study.jobs[0].key)
    assert keys[0] != keys[1] == keys[2]


ASIDE = "[starts]\nturned_rad = 0.0\nfaster_mps = 0.0\nright_m = "


@pytest.mark.parametrize(
    ("before", "after", "message"),
    [
        ("version = 2", "version = 1", "version is 1, expected 2; version 1 had other keys"),
        ("version = 2", "version = 2.0", "version is 2.0, expected 2"),
        ("roadproof-study", "other", "expected format"),
        ('controller = "cil"', 'controller = "cil"\nsimulator = "twon"', "simulator 'twon' is unknown"),
        ("seeds =", "seed =", "did you mean 'seeds'"),
        ("figures = [", "figures = [0, ", "figures has 0"),
        ('"straight-03"', '"straigt-03"', "did you mean 'straight-03'"),
        ("rainy-noon", "foggy", "weathers.*foggy"),
        ('search = "gradopt"', 'search = "magic"', "search is 'magic'"),
        ('search = "gradopt"\n', "", "method lacks search"),
        ("trajectories = 1", "trajectories = 2", "T is 2 trajectories, expected one of 1, 3, 5, 7"),
        ("trajectories = 1", 'trajectories = "1"', "trajectories is '1', expected int, got str"),
        ('name = "BO"', 'name = "GradOpt"', "method has GradOpt twice"),
        ('name = "BO"', 'name = " "', "name of a method is ' ', expected letters that can be printed"),
        ('name = "BO"', 'name = "B\\nO"', "name of a method is 'B.nO', expected letters"),
        ("figures = [", "figures = [1000000000, ", "figures has 1000000000, expected 1 to 64"),
        ("seeds = [0, 1]", "seeds = [10000000000000000000]", "seeds is 1"),
        ("runs = 4", "cars = 1000000", "cars is 1000000, expected 0 to 500"),
        ("figures = [", "figures = [5, ", "figures has 5 twice"),
        ("seeds = [0, 1]", "seeds = [0, 0]", "seeds has 0 twice"),
        ("seeds = [0, 1]", "seeds = [0.5]", "seeds.* expected int, got float"),
        ("seeds = [0, 1]", 'seeds = ["a"]', "seeds.* expected int, got str"),
        ("seeds = [0, 1]", "seeds = [-1]", "seeds is -1"),
        ('"rainy-noon"', '"clear-noon"', "weathers has clear-noon twice"),
        ("calls = 100\n", "calls = 40\n", "random_calls is 40 of 40 calls"),
        ('search = "published-bo"', 'search = "tpe"', "random_calls is 40, which search tpe has not; leave it out"),
        ("runs = 4", "runs = 0", "runs is 0"),
        ("runs = 4", "cars = 0\npedestrians = 0", "leave .traffic. out"),
        ("runs = 4", 'weathers = "some"', "weathers is 'some'"),
        ("trajectories = 1", "trajectories = 9", "T is 9 trajectories"),
        ("trajectories = 1", 'schedule = "slow"', "unknown key 'schedule'"),
        ("trajectories = 1", "calls = 3", "method GradOpt: search gradopt has no calls; leave it out, or choose"),
        ("calls = 100", "restarts = 3", "method BO: search published-bo has no restarts; leave it out, or choose"),
        (
            'search = "gradopt"\nobjective = "steering"',
            'search = "published"\nobjective = "deviation"',
            "search published has no objective; leave it out, or choose another search",
        ),
        (
            'objective = "steering"\ntrajectories = 1',
            "trajectories = 1",
            "expected scheme group and trajectories 3 or more",
        ),
        ("seeds =", 'reference = "TPE"\nseeds =', "reference is 'TPE', expected one of GradOpt, BO"),
        ("trajectories = 1", 'calibration = "by eye"', "calibration is 'by eye'"),
        ("trajectories = 1", "restarts = 5000", "method GradOpt: restarts is 5000, expected int <= 1000"),
        ("trajectories = 1", "frames = 0", "0 frames; expected all above 0"),
        ("calls = 100", 'objective = "fame"', "objective is 'fame'"),
        ("calls = 100", 'start = "luck"', "start is 'luck', expected int, got str"),
        ("calls = 100", 'start = 2\nwhere = "recorded"', "start is 2 with where recorded"),
        ("[traffic]", "[traffic", "not valid TOML"),
        ('controller = "cil"\n', "", "lacks controller"),
        ("seeds = [0, 1]", 'scenario_file = "../own.toml"', "leaves the study's folder"),
        ("[traffic]", "[starts]\nright_m = 1.0\nturned_rad = 0.3\n\n[traffic]", "starts of left-01 reach 1 m to the"),
        ("[traffic]", "[paint]\nkeep_out_m = 10.0\n\n[traffic]", r"\[paint\] on left-01: a keep-out of 10 m"),
        ("[traffic]", '[paint]\ncolours = ["#ff8000"]\n\n[traffic]', "the limits on colour leave no black"),
        (
            "[traffic]",
            "[paint]\ncontrast = [0.0, 0.3]\n\n[traffic]",
            "paint.contrast needs .* asphalt for method BO, which",
        ),
        ("[traffic]", f"{ASIDE}0.0\n\n[traffic]", "starts has the scenario's own among those drawn"),
        ("[traffic]", f"{ASIDE}0.00001\n\n[traffic]", "starts has the scenario's own among those drawn"),
    ],
)
def test_mistakes_are_named(tmp_path, before, after, message):
    assert before in TEXT
    with pytest.raises(RoadproofError, match=message) as caught:
        load_study(written(tmp_path, TEXT.replace(before, after, 1)))
    assert "\n" not in str(caught.value)


def test_colours_that_the_published_baseline_had_not_leave_it_no_paint(tmp_path):
    white = TEXT.replace('"1-b", ', "").replace("[traffic]", '[paint]\ncolours = ["#ffffff"]\n\n[traffic]')
    with pytest.raises(StudyError, match=r"\[paint\] on left-01: none of the colours #ffffff is left"):
        load_study(written(tmp_path, white))
    alone = white[: white.index('[[method]]\nname = "BO"')]
    assert len(load_study(written(tmp_path, alone)).methods) == 1


def test_a_contrast_is_kept_to_where_the_asphalt_is_measured_or_given(tmp_path):
    paint = "[paint]\ncontrast = [0.0, 0.6]\n"
    coloured = TEXT.replace('"1-b", ', "").replace("[traffic]", f"{paint}\n[traffic]")
    assert load_study(written(tmp_path, coloured[: coloured.index('[[method]]\nname = "BO"')])).paint is not None
    assert load_study(written(tmp_path, coloured.replace(paint, f'{paint}asphalt = "#5a5a5b"\n'))).paint is not None


def test_a_study_that_is_not_there_is_named(tmp_path):
    with pytest.raises(StudyError, match="cannot read"):
        load_study(tmp_path / "none.toml")


def test_every_built_in_scenario_can_be_chosen(tmp_path):
    study = load_study(written(tmp_path, TEXT.replace('["left-0[12]", "straight-03"]', '["*"]')))
    assert study.scenarios == builtin_scenarios()


STUDIES = sorted((Path(__file__).parents[2] / "studies").glob("*.toml"))


@pytest.mark.parametrize("path", STUDIES, ids=[path.stem for path in STUDIES])
def test_the_studies_that_come_with_the_project_can_be_read(path):
    study = load_study(path)
    searches = {method.search for method in study.methods}
    hardened = path.stem.startswith("hardened-") and searches == {"tpe"}
    assert "gradopt" in searches or hardened or path.stem == "cil-published"
    assert {"published-bo", "published"} & searches or hardened or path.stem in ("ablation", "weathers")
    assert len(study.jobs) == len({job.key for job in study.jobs})


def test_the_paper_s_study_is_the_paper_s():
    study = load_study(next(path for path in STUDIES if path.stem == "paper"))
    assert len(study.scenarios) == 40
    assert study.figures == ("1-b", 1, 2, 3, 4, 5)
    assert len(study.weathers) == 4
    last = study.methods[-1]
    assert (last.search, last.calls, last.random_calls) == ("published-bo", 1000, 400)


@pytest.mark.parametrize(
    ("kind", "values", "message"),
    [
        (GradOptPlan, {"restarts": 0}, "restarts is 0"),
        (GradOptPlan, {"restarts": 7}, "restarts is 7, expected 1 to 6 places to compete for"),
        (GradOptPlan, {"swerves_m": (99.0,)}, "expected one or more between 0.1 and 5"),
        (GradOptPlan, {"rounds": 1, "select": 0}, "select 1 or more"),
        (PublishedPlan, {"masks": "none"}, "masks is 'none'"),
        (PublishedPlan, {"noise_deg": (99, 3)}, "steering noise is 99…3°"),
        (BlackBoxPlan, {"search": "luck"}, "method is 'luck'"),
        (TrafficPlan, {"cars": 0, "pedestrians": 0}, "leave .traffic. out"),
        (StartPlan, {"right_m": 2.0}, "right_m of the starts is 2.0, expected a number from 0 to 1"),
        (StartPlan, {"count": 0}, "count is 0, expected 1 to 1000"),
    ],
)
def test_a_plan_made_in_python_is_checked_by_the_objects_it_is_for(kind, values, message):
    name = {} if kind in (TrafficPlan, StartPlan) else {"name": "a"}
    with pytest.raises(RoadproofError, match=message):
        kind(**name, **values)


def test_limits_in_a_simulator_of_which_the_map_is_not_known_are_checked_as_far_as_they_can_be(tmp_path):
    far = TEXT.replace('controller = "cil"', 'controller = "cil"\nsimulator = "carla://localhost:2000"')
    assert load_study(
        written(tmp_path, far.replace("[traffic]", "[paint]\nkeep_out_m = 10.0\n\n[traffic]")), trust=True
    )
    with pytest.raises(StudyError, match="the limits on colour leave no black"):
        load_study(
            written(tmp_path, far.replace("[traffic]", '[paint]\ncolours = ["#ff8000"]\n\n[traffic]')), trust=True
        )

"""GradOpt: a known optimum is found, batches equal single searches, interrupted searches go on."""

import dataclasses
import json
from functools import partial

import numpy as np
import pytest
import torch
from safetensors import SafetensorError

from roadproof.attacks import (
    CMAES,
    AttackResult,
    GradOpt,
    Method,
    PathDeviation,
    Published,
    SteeringShift,
    Surrogate,
    attack,
    kept_attack,
    methods,
)
from roadproof.attacks.checks import random_search
from roadproof.attacks.gradopt import Rung, Search, dropping, gradopt
from roadproof.attacks.groups import LEFT_GROUP, RIGHT_GROUP, parse_groups
from roadproof.attacks.methods import method_of
from roadproof.attacks.published import PublishedMeasure
from roadproof.compositing import Variation, composite, view_canvas
from roadproof.coverage import Shape
from roadproof.datatypes import Control
from roadproof.errors import ControllerError, OutputError, PatternError, RecordingError, RoadproofError
from roadproof.paint.site import LaneMark
from roadproof.patterns import Pattern, boxes_from_published
from roadproof.photometry import AffineResponse, ColourTransform, PixelMaps
from roadproof.search_space import SearchSpace
from scenes import LinearController, recording_set

QUICK = GradOpt(iterations=20, restarts=2, halving=False)


@dataclasses.dataclass(frozen=True, kw_only=True)
class Laddered(GradOpt):
    """GradOpt with few starts on its first rungs."""

    first: tuple[Rung, ...] = (Rung(4, 2, every=2),)

    def ladder(self, objective):
        return (
            *self.first,
            *GradOpt(iterations=self.iterations, restarts=self.restarts, halving=False).ladder(objective),
        )


def stretched(iterations, starts):
    """As the paper drops its rate, over fewer iterations."""
    return dropping(starts, iterations, 0.1, after=(0.4, 0.8), factor=0.1)


def pull_to_the_right(scale=1e-3):
    """Brightness on the right half of the picture steers right, on the left half left."""
    weight = torch.zeros(3, 88, 200)
    weight[:, :, 100:], weight[:, :, :100] = scale, -scale
    return LinearController(weight)


def target_controller(recordings, box, scale=1e-3):
    """A linear controller that answers most to white paint exactly in one rectangle, and against paint elsewhere."""
    drive = recordings.recordings[0]
    view = view_canvas(drive.frames[-1:], drive.image_from_canvas[-1:], recordings.view, recordings.colour)
    white = Pattern((Shape.RECTANGLE,), box[None], torch.ones(1, 3))
    painted = (composite(white, view)[0] - view.clean_frames[0]).mean(0)
    weight = torch.where(painted > 0.2, 1.0, -1.0) * scale
    return LinearController(weight.expand(3, -1, -1).clone())


def test_the_known_optimum_of_a_linear_controller_is_found():
    everything = recording_set(frames=2)
    drive = everything.recordings[0]
    last = dataclasses.replace(
        drive,
        **{
            name: getattr(drive, name)[-1:]
            for name in ("frames", "frame_number", "image_from_canvas", "speed_mps", "command", "steer")
        },
    )
    recordings = dataclasses.replace(everything, recordings=(last,))
    published = torch.tensor([40.0, 170.0, 60.0, 30.0])
    controller = target_controller(recordings, boxes_from_published(published[None])[0])
    space = SearchSpace(figures=1)
    optimum_at = torch.cat([published / torch.tensor([180.0, 380.0, 100.0, 70.0]), torch.ones(3)])
    groups = parse_groups("all", recordings)
    surrogate = Surrogate(recordings, controller, groups)
    optimum = float(surrogate.values(space, optimum_at[None, None, None])[0, 0])
    found = attack(recordings, controller, space, groups=groups, seed=1)
    assert optimum > 0
    assert found.surrogate_shift / optimum >= 0.95


def test_both_sides_are_searched_and_the_stronger_is_kept():
    result = attack(recording_set(), pull_to_the_right(), SearchSpace(figures=2), method=QUICK)
    assert set(result.by_group) == {"clean+right", "clean+left"}
    assert result.surrogate_shift == max(result.by_group.values())
    assert min(result.by_group.values()) > 0
    assert result.history.shape == (20, 2, 2)
    assert result.cost.controller_frames > 20 * 2 * 2 * 8


def test_the_best_pattern_is_the_one_the_history_promises():
    recordings, controller, space = recording_set(), pull_to_the_right(), SearchSpace(figures=2)
    result = attack(recordings, controller, space, method=QUICK)
    surrogate = Surrogate(recordings, controller, (RIGHT_GROUP, LEFT_GROUP))
    batch = Pattern(result.pattern.shapes, result.pattern.boxes[None], result.pattern.colours[None])
    shown = surrogate.divergences([batch, batch])[:, 0]
    assert float(shown.max()) == pytest.approx(result.surrogate_shift, rel=1e-5)
    assert result.surrogate_shift == pytest.approx(result.history.max(), rel=1e-6)


def test_the_same_seed_gives_the_same_result_and_another_seed_another():
    run = lambda seed: attack(  # noqa: E731
        recording_set(), pull_to_the_right(), SearchSpace(figures=2), method=QUICK, seed=seed
    )
    one, again, other = run(3), run(3), run(4)
    np.testing.assert_array_equal(one.history, again.history)
    assert torch.equal(one.pattern.boxes, again.pattern.boxes)
    assert not np.array_equal(one.history, other.history)


def test_restarts_in_one_batch_are_the_restarts_one_by_one(monkeypatch):
    recordings, controller, space = recording_set(), pull_to_the_right(), SearchSpace(figures=2)
    together = attack(recordings, controller, space, method=dataclasses.replace(QUICK, restarts=4))
    monkeypatch.setattr("roadproof.attacks.surrogate.MAX_FRAMES", 1)
    apart = attack(recordings, controller, space, method=dataclasses.replace(QUICK, restarts=4))
    np.testing.assert_allclose(together.history, apart.history, rtol=1e-3, atol=1e-4)


def test_each_drop_of_the_rate_starts_from_the_best_so_far():
    surrogate = Surrogate(recording_set(), pull_to_the_right(), (RIGHT_GROUP,))
    search = gradopt(surrogate, SearchSpace(figures=1), (Rung(3, 6), Rung(3, 3, 0.01)), seed=0)
    assert len(search.history) == 9
    torch.testing.assert_close(search.history[6], search.history[:6].amax(0), rtol=1e-4, atol=1e-5)


def test_the_best_of_a_rung_go_on():
    surrogate = Surrogate(recording_set(), pull_to_the_right(), (RIGHT_GROUP, LEFT_GROUP))
    space = SearchSpace(figures=2)
    alone = gradopt(surrogate, space, (Rung(6, 3),), seed=3)
    chosen = gradopt(surrogate, space, (Rung(6, 3), Rung(2, 1)), seed=3).history[0]
    torch.testing.assert_close(chosen, alone.best.topk(2).values, rtol=1e-4, atol=1e-5)


def test_first_rungs_run_on_few_frames_and_their_cost_is_counted():
    surrogate = Surrogate(recording_set(frames=4), pull_to_the_right(), (RIGHT_GROUP,))
    assert surrogate.thinned(3).lengths == [[2, 2]]


def test_drives_whose_last_frames_are_past_the_canvas_are_searched_on_all_frames():
    whole, away, drives = recording_set(), np.array([[1.0, 0, 1e5], [0, 1, 0], [0, 0, 1]]), []
    for drive in whole.recordings:
        seen = drive.image_from_canvas.copy()
        seen[-1] = away @ seen[-1]
        drives.append(dataclasses.replace(drive, image_from_canvas=seen))
    surrogate = Surrogate(dataclasses.replace(whole, recordings=tuple(drives)), pull_to_the_right(), (RIGHT_GROUP,))
    assert surrogate.thinned(2).lengths == [[2, 2]]
    search = gradopt(surrogate, SearchSpace(figures=1), (Rung(2, 3, every=4), Rung(1, 3)), seed=0)
    assert search.best.isfinite().all()
    before, steps = surrogate.frames_evaluated, []
    on_step = lambda step, _best: steps.append(step)  # noqa: E731
    gradopt(surrogate, SearchSpace(figures=1), (Rung(3, 5, every=2), Rung(1, 2)), seed=0, on_step=on_step)
    clean, first, search = 4, 3 * 5 * 4, 2 * 8
    assert surrogate.frames_evaluated - before == clean + first + search
    assert steps == list(range(1, 8))


def test_competing_starts_find_more_than_random_starts_of_equal_cost():
    surrogate = Surrogate(recording_set(), pull_to_the_right(), (RIGHT_GROUP, LEFT_GROUP))
    search = lambda *rungs: gradopt(surrogate, SearchSpace(figures=3), rungs, seed=0)  # noqa: E731
    assert (search(Rung(12, 5, every=2), Rung(2, 10)).best.mean(1) > search(Rung(2, 25)).best.mean(1)).all()


class InterruptionError(Exception):
    pass


@pytest.mark.parametrize("at", [1, 2, 3, 4, 5, 13])
def test_an_interrupted_search_goes_on_to_the_same_result(tmp_path, at):
    """Within the first rung, at its end, within the second, at its end, and in those of the search proper."""
    method = Laddered(iterations=11, restarts=2, first=(Rung(4, 2, every=2), Rung(3, 2)))

    def run(checkpoint, on_step=lambda _step, _best: None):
        return attack(
            recording_set(),
            pull_to_the_right(),
            SearchSpace(figures=2),
            method=method,
            checkpoint=checkpoint,
            on_step=on_step,
        )

    def interrupt(step, _best):
        if step == at:
            raise InterruptionError

    steps = []
    with pytest.raises(InterruptionError):
        run(tmp_path / "search.safetensors", interrupt)
    resumed = run(tmp_path / "search.safetensors", lambda step, _best: steps.append(step))
    # The step that was interrupted may be repeated, no other.
    assert steps == list(range(at, 16))
    straight = run(None)
    np.testing.assert_array_equal(resumed.history, straight.history)
    for one, other in zip(resumed.candidates, straight.candidates, strict=True):
        assert torch.equal(one.pattern.boxes, other.pattern.boxes)
    assert resumed.cost.controller_frames == straight.cost.controller_frames


def test_a_search_goes_on_from_the_candidates_of_another():
    recordings, controller, space = recording_set(), pull_to_the_right(), SearchSpace(figures=2)
    first = attack(recordings, controller, space, method=QUICK)
    again = GradOpt(iterations=3, restarts=3, halving=False)
    more = attack(recordings, controller, space, method=again, starts=first.candidates, seed=7)
    for group, best in first.by_group.items():
        assert more.by_group[group] >= best - 1e-4
    found = {name: [c.surrogate_shift for c in first.candidates if c.group == name] for name in first.by_group}
    for number, name in enumerate(first.by_group):
        np.testing.assert_allclose(more.history[0, number, :2], found[name], atol=1e-3)
        assert abs(more.history[0, number, 2] - found[name][0]) > 1e-3, "the third start is a random one"


class InDouble:
    """The steering shift as a measure of a user's own, in double precision."""

    def __init__(self, exact):
        self.exact, self.groups, self.device, self.frames_evaluated = exact, exact.groups, exact.device, 0

    def values(self, space, unit):
        return self.exact.values(space, unit).double()

    def values_and_gradients(self, space, unit):
        value, gradient = self.exact.values_and_gradients(space, unit)
        return value.double(), gradient.double()

    def thinned(self, every):
        return InDouble(self.exact.thinned(every))

    def open_loop(self):
        return self

    def readings(self, space, unit):
        return self.values(space, unit), None

    def fingerprint(self):
        return f"in double {self.exact.fingerprint()}"


def test_a_measure_of_the_users_own_may_be_in_double_precision():
    surrogate, space = Surrogate(recording_set(), pull_to_the_right(), (RIGHT_GROUP,)), SearchSpace(figures=2)
    ladder = (Rung(3, 2, every=2, screened=1), Rung(2, 2, offspring=4), Rung(2, 2, 0.01))
    own = gradopt(InDouble(surrogate), space, ladder, seed=2)
    usual = gradopt(surrogate, space, ladder, seed=2)
    assert torch.equal(own.best_unit, usual.best_unit)
    assert torch.equal(own.history, usual.history)


class Drawn(Method):
    """A method of a user's own, which is no dataclass."""

    word = "drawn"

    def search(self, measure, space, **running):
        unit = space.random((len(measure.groups), 2), torch.Generator().manual_seed(running["seed"]))
        best = measure.values(space, unit)
        return Search(unit, best, best[None])


def test_a_method_of_the_users_own_need_not_be_a_dataclass():
    found = attack(recording_set(), pull_to_the_right(), SearchSpace(figures=2), method=Drawn())
    assert found.surrogate_shift == max(found.by_group.values())
    assert found.made_of["method"]["method"] == "drawn"


def test_starts_none_of_which_is_of_a_group_that_is_attacked_are_refused():
    recordings, controller, space = recording_set(), pull_to_the_right(), SearchSpace(figures=2)
    pooled = attack(recordings, controller, space, method=CMAES(calls=2))
    with pytest.raises(RecordingError, match=r"starts are of all, the groups are clean\+right, clean\+left; give"):
        attack(recordings, controller, space, method=QUICK, starts=pooled.candidates)
    for_right = [dataclasses.replace(each, group="clean+right") for each in pooled.candidates]
    method = GradOpt(iterations=1, restarts=2, halving=False)
    gone_on = attack(recordings, controller, space, method=method, starts=for_right)
    surrogate = Surrogate(recordings, controller, (RIGHT_GROUP,))
    begun = surrogate.values(space, torch.stack([space.point(each.pattern) for each in for_right])[None])
    np.testing.assert_allclose(gone_on.history[0, 0], begun[0], atol=1e-6)


def test_a_checkpoint_of_another_search_or_a_damaged_one_is_not_used(tmp_path):
    checkpoint = tmp_path / "search.safetensors"
    surrogate = Surrogate(recording_set(), pull_to_the_right(), (RIGHT_GROUP,))
    space = SearchSpace(figures=1)
    run = lambda seed: gradopt(surrogate, space, (Rung(1, 3),), seed=seed, checkpoint=checkpoint)  # noqa: E731
    first = run(0)
    second = run(1)
    assert not torch.equal(first.history, second.history)
    checkpoint.write_bytes(b"not a checkpoint")
    assert torch.equal(run(0).history, first.history)


def test_a_checkpoint_of_other_colours_or_of_another_controller_is_not_used(tmp_path):
    faint = ColourTransform(AffineResponse(0.2 * torch.eye(3), torch.full((3,), 0.4)))
    brakes, cannot_drive, another = pull_to_the_right(), pull_to_the_right(), pull_to_the_right()
    brakes.act = lambda *_: Control(steer=0.0, brake=0.5)
    cannot_drive.act = another.act = lambda *_: None
    another.weight *= 2
    measures = [
        Surrogate(recordings, controller, (RIGHT_GROUP,))
        for recordings, controller in (
            (recording_set(), pull_to_the_right()),
            (recording_set(colour=faint), pull_to_the_right()),
            (recording_set(), brakes),
            (recording_set(), cannot_drive),
            (recording_set(), another),
        )
    ]
    assert len({each.fingerprint() for each in measures}) == len(measures)
    again = Surrogate(recording_set(), pull_to_the_right(), (RIGHT_GROUP,))
    assert again.fingerprint() == measures[0].fingerprint()
    search = partial(gradopt, space=SearchSpace(figures=1), rungs=(Rung(1, 3),), seed=0)
    search(measures[0], checkpoint=tmp_path / "search.safetensors")
    gone_on = search(measures[1], checkpoint=tmp_path / "search.safetensors")
    assert torch.equal(gone_on.history, search(measures[1]).history)


def test_a_checkpoint_on_a_full_disk_is_one_clear_error(tmp_path, monkeypatch):
    def full(*args, **kwargs):
        raise SafetensorError("No space left on device")

    monkeypatch.setattr("safetensors.torch.save_file", full)
    surrogate = Surrogate(recording_set(), pull_to_the_right(), (RIGHT_GROUP,))
    checkpoint = tmp_path / "search.safetensors"
    with pytest.raises(OutputError, match="No space left"):
        gradopt(surrogate, SearchSpace(figures=1), (Rung(1, 2),), seed=0, checkpoint=checkpoint)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("masks", ["binary", "antialiased"])
@pytest.mark.parametrize(
    "space",
    [
        SearchSpace(figures=2),
        SearchSpace(figures=1, colour=False),
        SearchSpace(figures=1, family="published-canvas-centre"),
    ],
    ids=["coloured", "black", "canvas centre"],
)
def test_the_published_gradient_climbs(masks, space):
    measure = PublishedMeasure(recording_set(frames=2), pull_to_the_right(), (RIGHT_GROUP,), masks=masks)
    search = gradopt(measure.on_grid(10.0), space, (Rung(2, 12),), momentum=0.0, seed=0)
    assert bool((search.best >= search.history[0]).all())
    assert float(search.best.max()) > float(search.history[0].max()) + 0.1


def test_the_published_measure_sums_frames_as_the_paper_does():
    recordings, space = recording_set(frames=3), SearchSpace(figures=2)
    published = PublishedMeasure(recordings, pull_to_the_right(), (RIGHT_GROUP,), masks="antialiased")
    exact = Surrogate(recordings, pull_to_the_right(), (RIGHT_GROUP,))
    unit = space.random((1, 2), torch.Generator().manual_seed(0))
    # Six frames: three of the clean drive and three of the one to the right.
    torch.testing.assert_close(published.values(space, unit), 6 * exact.values(space, unit), rtol=1e-4, atol=1e-4)
    torch.testing.assert_close(published.readings(space, unit)[0], exact.values(space, unit), rtol=1e-4, atol=1e-4)


def test_the_published_search_does_without_pixel_maps_or_says_so():
    bare, controller = recording_set(frames=2), pull_to_the_right()
    shape = (2, *bare.recordings[0].frames.shape[1:3])
    maps = PixelMaps(torch.ones(*shape, 3), torch.zeros(*shape, 3), torch.ones(shape))
    with_maps = (dataclasses.replace(each, maps=maps) for each in bare.recordings)
    mapped = dataclasses.replace(bare, recordings=tuple(with_maps))
    with pytest.raises(RoadproofError, match="have it in pixel maps; calibrate with --method published"):
        Published().measure(SteeringShift(), mapped, controller, (RIGHT_GROUP,), device="cpu")
    Published().measure(SteeringShift(), bare, controller, (RIGHT_GROUP,), device="cpu")
    Published(masks="antialiased").measure(SteeringShift(), mapped, controller, (RIGHT_GROUP,), device="cpu")


@pytest.mark.parametrize("masks", ["binary", "antialiased"])
def test_the_local_linearisation_is_what_two_renderings_say(masks):
    """One parameter at a time, at both ends of its cell, every other as it is."""
    space = SearchSpace(figures=2)
    measure = PublishedMeasure(recording_set(frames=2), pull_to_the_right(), (RIGHT_GROUP,), masks=masks).on_grid(10.0)
    unit = space.random((1, 1), torch.Generator().manual_seed(3))
    _, gradient = measure.values_and_gradients(space, unit)
    spans = torch.tensor(space.shape_ranges)
    for figure, parameter in ((0, 0), (1, 1), (0, 2), (1, 3)):
        low = float((unit[0, 0, figure, parameter] * spans[parameter] / 10).floor() * 10 / spans[parameter])
        ends = unit.repeat(1, 2, 1, 1)
        ends[0, :, figure, parameter] = torch.tensor([low, low + float(10 / spans[parameter])])
        below, above = measure.values(space, ends)[0].tolist()
        told = (above - below) * float(spans[parameter] / 10)
        # This controller is linear in the picture, so that linearised and true differences are equal.
        assert float(gradient[0, 0, figure, parameter]) == pytest.approx(told, rel=0.02, abs=0.02)


def test_the_published_search_refuses_what_was_not_published():
    recordings, controller = recording_set(frames=2), pull_to_the_right()
    for other in ({"family": "free"}, {"family": "published-bo"}, {"albedo": (0.2, 0.8)}, {"max_painted_share": 0.1}):
        with pytest.raises(PatternError, match="families published and published-canvas-centre alone, without limits"):
            attack(recordings, controller, SearchSpace(figures=1, **other), method=Published())
    varied = SteeringShift(variation=Variation())
    with pytest.raises(RoadproofError, match="the published search knows no variation"):
        attack(recordings, controller, SearchSpace(figures=1), method=Published(), objective=varied)
    with pytest.raises(RoadproofError, match="enlarges the steering shift, not the path deviation"):
        attack(recordings, controller, SearchSpace(figures=1), method=Published(), objective=PathDeviation())
    with pytest.raises(RoadproofError, match="masks is 'soft', expected binary or antialiased"):
        Published(masks="soft")
    with pytest.raises(RoadproofError, match="method published has no iterations; it has masks, restarts"):
        method_of("published", iterations=3)


def test_gradients_beat_random_search_of_equal_cost():
    surrogate = Surrogate(recording_set(), pull_to_the_right(), (RIGHT_GROUP, LEFT_GROUP))
    space = SearchSpace(figures=3)
    search = gradopt(surrogate, space, stretched(40, 2), seed=0)
    _, by_chance = random_search(surrogate, space, patterns=80, seed=5)
    assert (search.best.amax(1) > by_chance).all()


def test_a_result_is_the_same_when_loaded(tmp_path):
    result = attack(recording_set(), pull_to_the_right(), SearchSpace(figures=2), method=QUICK, random_patterns=4)
    result.save(tmp_path)
    loaded = AttackResult.load(tmp_path)
    torch.testing.assert_close(loaded.pattern.boxes, result.pattern.boxes)
    np.testing.assert_allclose(loaded.history, result.history, atol=1e-6)
    for name in ("group", "surrogate_shift", "by_group", "cost", "checks", "space", "method", "seed"):
        assert getattr(loaded, name) == getattr(result, name), name


def test_a_search_that_was_kept_is_read_and_one_of_other_parts_is_refused(tmp_path):
    controller, asked = pull_to_the_right(), {"objective": SteeringShift(), "method": QUICK}
    trained_again = pull_to_the_right()
    trained_again.act = lambda *_: Control(steer=0.1)
    cannot_drive = pull_to_the_right()
    cannot_drive.act = lambda *_: None

    def kept(recordings=recording_set(), space=SearchSpace(figures=1), driver=controller, **changed):  # noqa: B008
        return kept_attack(tmp_path, recordings, driver, space, **asked | changed)

    first = kept()
    stamp = (tmp_path / "result.json").stat().st_mtime_ns
    np.testing.assert_allclose(kept().history, first.history)
    assert (tmp_path / "result.json").stat().st_mtime_ns == stamp
    one, *others = recording_set().recordings
    for message, changed in {
        "holds a search with seed 0, now it is 1": {"seed": 1},
        "holds a search with space.figures 1, now it is 2": {"space": SearchSpace(figures=2)},
        "holds a search with method.iterations 20, now it is 30": {"method": dataclasses.replace(QUICK, iterations=30)},
        "holds a search with drives '": {
            "recordings": dataclasses.replace(
                recording_set(), recordings=(dataclasses.replace(one, frames=one.frames // 2), *others)
            )
        },
        "objective 'steering shift', now it is 'steering shift over var": {
            "objective": SteeringShift(variation=Variation())
        },
        "holds a search of another controller, which answers otherwise": {"driver": trained_again},
        "holds a search, perhaps of another controller: this one cannot drive": {"driver": cannot_drive, "seed": 1},
    }.items():
        with pytest.raises(RoadproofError, match=message):
            kept(**changed)
    content = json.loads((tmp_path / "result.json").read_text())
    without = {k: v for k, v in content.items() if k != "made_of"}
    for silent in (without, without | {"made_of": {}}):
        (tmp_path / "result.json").write_text(json.dumps(silent))
        with pytest.raises(RoadproofError, match="a search that does not say what it was made of; choose another fold"):
            kept()
    attack(recording_set(), controller, SearchSpace(figures=1), **asked).save(tmp_path)
    assert kept().seed == 0
    with pytest.raises(RoadproofError, match="holds a search with seed 0, now it is 1"):
        kept(seed=1)


@dataclasses.dataclass(frozen=True)
class Doubled:
    """An objective of a user's own, with a name that does not tell its factor."""

    factor: float = 2.0
    name = "doubled"

    def measure(self, recordings, controller, groups, *, device):
        return SteeringShift().measure(recordings, controller, groups, device=device)


def test_a_search_is_known_by_its_starts_its_marks_and_the_fields_of_a_users_objective(tmp_path):
    marked = dataclasses.replace(recording_set(), marks=(LaneMark(points_m=((1.0, 0.0), (1.0, 2.0))),))
    first = kept_attack(
        tmp_path, marked, pull_to_the_right(), SearchSpace(figures=1), objective=Doubled(), method=QUICK
    )
    for message, changed in {
        r"objective_fields\.fields\.factor 2\.0, now it is 3\.0": {"objective": Doubled(3.0)},
        "holds a search with starts": {"starts": first.candidates[:1]},
        "holds a search with marks": {"recordings": dataclasses.replace(marked, marks=())},
    }.items():
        asked = {"recordings": marked, "objective": Doubled()} | changed
        with pytest.raises(RoadproofError, match=message):
            kept_attack(tmp_path, controller=pull_to_the_right(), space=SearchSpace(figures=1), method=QUICK, **asked)


def test_a_controller_for_other_frames_or_one_that_answers_nan_is_refused():
    controller = pull_to_the_right()
    controller.input_size = (66, 200)
    with pytest.raises(ControllerError, match="takes frames of 200×66"):
        Surrogate(recording_set(), controller, (RIGHT_GROUP,))
    with pytest.raises(ControllerError, match="NaN"):
        Surrogate(recording_set(), LinearController(torch.full((3, 88, 200), torch.nan)), (RIGHT_GROUP,))


@pytest.mark.parametrize("seed", [-1, 2**32, True])
def test_a_seed_that_is_no_whole_number_in_its_range_is_one_line(seed):
    with pytest.raises(RoadproofError, match=f"seed is {seed!r}, expected a whole number from 0 to 4,294,967,295"):
        attack(recording_set(), pull_to_the_right(), SearchSpace(figures=1), method=QUICK, seed=seed)


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"random_patterns": -3}, "random_patterns is -3, expected a whole number, 0 or more"),
        ({"device": "gpu"}, "device 'gpu' is unknown, expected cpu, cuda"),
    ],
)
def test_what_an_attack_cannot_use_is_one_line(given, message):
    with pytest.raises(RoadproofError, match=message):
        attack(recording_set(), pull_to_the_right(), SearchSpace(figures=1), method=QUICK, **given)


def test_methods_that_make_no_sense_are_refused():
    for wrong in ({"iterations": 0}, {"restarts": 0}, {"restarts": True}, {"restarts": 9}):
        with pytest.raises(RoadproofError, match=f"{next(iter(wrong))} is {next(iter(wrong.values()))}, expected"):
            GradOpt(**wrong)
    assert GradOpt(restarts=9, halving=False).restarts == 9
    with pytest.raises(RoadproofError, match="too small"):
        Rung(4, 2, every=0)
    with pytest.raises(RoadproofError, match="method is 'magic', expected one of gradopt, published"):
        method_of("magic")


def test_the_published_steps_are_the_papers():
    rungs = Published().ladder
    assert [(rung.starts, rung.iterations, rung.learning_rate, rung.grid) for rung in rungs] == [
        (4, 100, 0.1, 10.0),
        (4, 100, 0.01, 1.0),
        (4, 50, 0.001, 1.0),
    ]
    assert Published().steps(SteeringShift()) == 250


def test_a_published_search_tells_the_shift_of_a_frame_beside_its_sums(monkeypatch):
    monkeypatch.setattr(Published, "ladder", property(lambda _: (methods._OnGrid(1, 3, 0.1, grid=10.0),)))
    recordings, controller = recording_set(frames=3), pull_to_the_right()
    found = attack(recordings, controller, SearchSpace(figures=2), method=Published(restarts=1))
    frames = sum(len(drive.frames) for drive in RIGHT_GROUP.select(recordings))
    best = {each.group: each.surrogate_shift for each in found.candidates}
    assert frames > 1
    assert best[str(RIGHT_GROUP)] == pytest.approx(found.by_group[str(RIGHT_GROUP)] / frames, rel=1e-4)
    assert found.made_large == "steering shift, steer, summed over frames"


def test_a_result_that_names_no_method_is_refused_in_one_line(tmp_path):
    attack(recording_set(), pull_to_the_right(), SearchSpace(figures=1), method=QUICK).save(tmp_path)
    told = json.loads((tmp_path / "result.json").read_text())
    del told["method"]
    told |= {"version": 1, "restarts": 3, "schedule": {"iterations": 30, "heats": [{"starts": 24}]}}
    (tmp_path / "result.json").write_text(json.dumps(told))
    with pytest.raises(RoadproofError, match=r"result\.json is incomplete .*`method`.*; search again$"):
        AttackResult.load(tmp_path)

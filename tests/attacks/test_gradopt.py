"""GradOpt: a known optimum is found, batches equal single searches, interrupted searches go on."""

import dataclasses

import numpy as np
import pytest
import torch
from safetensors import SafetensorError

from roadproof.attacks import AttackResult, Heat, Schedule, Surrogate, attack
from roadproof.attacks.gradopt import gradopt, random_search
from roadproof.attacks.published import PublishedSurrogate
from roadproof.compositing import composite, view_canvas
from roadproof.coverage import Shape
from roadproof.errors import ControllerError, OutputError, PatternError, RoadproofError
from roadproof.objectives import LEFT_GROUP, RIGHT_GROUP, parse_groups
from roadproof.patterns import Pattern, boxes_from_published
from roadproof.search_space import SearchSpace
from scenes import LinearController, recording_set

QUICK = Schedule.stretched(20)
HEATED = dataclasses.replace(QUICK, heats=(Heat(starts=4, iterations=2, every=2),))


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
    result = attack(recording_set(), pull_to_the_right(), SearchSpace(figures=2), schedule=QUICK, restarts=2)
    assert set(result.by_group) == {"clean+right", "clean+left"}
    assert result.surrogate_shift == max(result.by_group.values())
    assert min(result.by_group.values()) > 0
    assert result.history.shape == (20, 2, 2)
    assert result.stopped == "all iterations done"
    assert result.cost.controller_frames > 20 * 2 * 2 * 8


def test_the_best_pattern_is_the_one_the_history_promises():
    recordings, controller, space = recording_set(), pull_to_the_right(), SearchSpace(figures=2)
    result = attack(recordings, controller, space, schedule=QUICK, restarts=2)
    surrogate = Surrogate(recordings, controller, (RIGHT_GROUP, LEFT_GROUP))
    batch = Pattern(result.pattern.shapes, result.pattern.boxes[None], result.pattern.colours[None])
    shown = surrogate.divergences([batch, batch])[:, 0]
    assert float(shown.max()) == pytest.approx(result.surrogate_shift, rel=1e-5)
    assert result.surrogate_shift == pytest.approx(result.history.max(), rel=1e-6)


def test_the_same_seed_gives_the_same_result_and_another_seed_another():
    run = lambda seed: attack(  # noqa: E731
        recording_set(), pull_to_the_right(), SearchSpace(figures=2), schedule=QUICK, restarts=2, seed=seed
    )
    one, again, other = run(3), run(3), run(4)
    np.testing.assert_array_equal(one.history, again.history)
    assert torch.equal(one.pattern.boxes, again.pattern.boxes)
    assert not np.array_equal(one.history, other.history)


def test_restarts_in_one_batch_are_the_restarts_one_by_one(monkeypatch):
    recordings, controller, space = recording_set(), pull_to_the_right(), SearchSpace(figures=2)
    together = attack(recordings, controller, space, schedule=QUICK, restarts=4)
    monkeypatch.setattr("roadproof.attacks.surrogate.MAX_FRAMES", 1)
    apart = attack(recordings, controller, space, schedule=QUICK, restarts=4)
    np.testing.assert_allclose(together.history, apart.history, rtol=1e-3, atol=1e-4)


def test_each_drop_of_the_rate_starts_from_the_best_so_far():
    surrogate = Surrogate(recording_set(), pull_to_the_right(), (RIGHT_GROUP,))
    search = gradopt(surrogate, SearchSpace(figures=1), schedule=Schedule(iterations=9, drops=(6,)), restarts=3, seed=0)
    torch.testing.assert_close(search.history[6], search.history[:6].amax(0), rtol=1e-4, atol=1e-5)


def test_the_best_of_a_heat_go_on():
    surrogate = Surrogate(recording_set(), pull_to_the_right(), (RIGHT_GROUP, LEFT_GROUP))
    space, heat = SearchSpace(figures=2), Schedule(iterations=3, drops=())
    alone = gradopt(surrogate, space, schedule=heat, restarts=6, seed=3)
    schedule = Schedule(iterations=1, heats=(Heat(starts=6, iterations=3, every=1),))
    chosen = gradopt(surrogate, space, schedule=schedule, restarts=2, seed=3).history[0]
    torch.testing.assert_close(chosen, alone.best.topk(2).values, rtol=1e-4, atol=1e-5)


def test_heats_run_on_few_frames_and_their_cost_is_counted():
    surrogate = Surrogate(recording_set(frames=4), pull_to_the_right(), (RIGHT_GROUP,))
    assert surrogate.thinned(3).lengths == [[2, 2]]
    before, steps = surrogate.frames_evaluated, []
    schedule = Schedule(iterations=2, heats=(Heat(starts=3, iterations=5, every=2),))
    on_step = lambda step, _best: steps.append(step)  # noqa: E731
    gradopt(surrogate, SearchSpace(figures=1), schedule=schedule, restarts=1, seed=0, on_step=on_step)
    clean, heat, search = 4, 3 * 5 * 4, 2 * 8
    assert surrogate.frames_evaluated - before == clean + heat + search
    assert steps == list(range(1, schedule.steps + 1))


def test_heats_find_more_than_random_starts_of_equal_cost():
    surrogate = Surrogate(recording_set(), pull_to_the_right(), (RIGHT_GROUP, LEFT_GROUP))
    heats = Schedule(iterations=10, heats=(Heat(starts=12, iterations=5, every=2),))
    search = lambda schedule: gradopt(surrogate, SearchSpace(figures=3), schedule=schedule, restarts=2, seed=0)  # noqa: E731
    assert (search(heats).best.mean(1) > search(Schedule(iterations=25)).best.mean(1)).all()


class InterruptionError(Exception):
    pass


@pytest.mark.parametrize("at", [1, 2, 3, 4, 5, 13])
def test_an_interrupted_search_goes_on_to_the_same_result(tmp_path, at):
    """Within the first heat, at its end, within the second, at its end, and in the search proper."""
    schedule = dataclasses.replace(HEATED, iterations=11, heats=(*HEATED.heats, Heat(starts=3, iterations=2, every=1)))

    def run(checkpoint, on_step=lambda _step, _best: None):
        return attack(
            recording_set(),
            pull_to_the_right(),
            SearchSpace(figures=2),
            schedule=schedule,
            restarts=2,
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
    assert resumed.cost.controller_frames >= straight.cost.controller_frames


def test_a_search_that_stopped_early_is_not_searched_on(tmp_path):
    schedule = Schedule(iterations=200, drops=(10,), patience=8)
    surrogate = Surrogate(recording_set(), pull_to_the_right(), (RIGHT_GROUP,))
    run = lambda: gradopt(  # noqa: E731
        surrogate, SearchSpace(figures=1), schedule=schedule, restarts=1, seed=0, checkpoint=tmp_path / "s.safetensors"
    )
    once, again = run(), run()
    assert torch.equal(once.history, again.history)
    assert again.stopped == once.stopped


def test_a_search_goes_on_from_the_candidates_of_another():
    recordings, controller, space = recording_set(), pull_to_the_right(), SearchSpace(figures=2)
    first = attack(recordings, controller, space, schedule=QUICK, restarts=2)
    more = attack(
        recordings, controller, space, schedule=Schedule.stretched(3), restarts=3, starts=first.candidates, seed=7
    )
    for group, best in first.by_group.items():
        assert more.by_group[group] >= best - 1e-4
    found = {name: [c.surrogate_shift for c in first.candidates if c.group == name] for name in first.by_group}
    for number, name in enumerate(first.by_group):
        np.testing.assert_allclose(more.history[0, number, :2], found[name], atol=1e-3)
        assert abs(more.history[0, number, 2] - found[name][0]) > 1e-3, "the third start is a random one"


def test_a_checkpoint_of_another_search_or_a_damaged_one_is_not_used(tmp_path):
    checkpoint = tmp_path / "search.safetensors"
    surrogate = Surrogate(recording_set(), pull_to_the_right(), (RIGHT_GROUP,))
    space, short = SearchSpace(figures=1), Schedule.stretched(3)
    run = lambda seed: gradopt(surrogate, space, schedule=short, restarts=1, seed=seed, checkpoint=checkpoint)  # noqa: E731
    first = run(0)
    second = run(1)
    assert not torch.equal(first.history, second.history)
    checkpoint.write_bytes(b"not a checkpoint")
    assert torch.equal(run(0).history, first.history)


def test_a_checkpoint_on_a_full_disk_is_one_clear_error(tmp_path, monkeypatch):
    def full(*args, **kwargs):
        raise SafetensorError("No space left on device")

    monkeypatch.setattr("safetensors.torch.save_file", full)
    surrogate = Surrogate(recording_set(), pull_to_the_right(), (RIGHT_GROUP,))
    checkpoint, short = tmp_path / "search.safetensors", Schedule.stretched(2)
    with pytest.raises(OutputError, match="No space left"):
        gradopt(surrogate, SearchSpace(figures=1), schedule=short, restarts=1, seed=0, checkpoint=checkpoint)
    assert not list(tmp_path.iterdir())


def test_patience_ends_a_search_that_gains_nothing():
    schedule = Schedule(iterations=200, drops=(10,), patience=8)
    result = attack(recording_set(), pull_to_the_right(), SearchSpace(figures=1), schedule=schedule, restarts=1)
    assert len(result.history) < 200
    assert "last 8 iterations" in result.stopped


def test_the_published_gradient_climbs_too():
    space = SearchSpace(figures=1)
    surrogate = PublishedSurrogate(recording_set(frames=2), pull_to_the_right(), (RIGHT_GROUP,))
    search = gradopt(surrogate, space, schedule=Schedule.stretched(15), restarts=2, seed=0)
    assert bool((search.best > search.history[0] + 0.1).all())
    with pytest.raises(PatternError, match="published family"):
        surrogate.values(SearchSpace(figures=1, family="free"), torch.rand(1, 1, 1, 8))


def test_gradients_beat_random_search_of_equal_cost():
    surrogate = Surrogate(recording_set(), pull_to_the_right(), (RIGHT_GROUP, LEFT_GROUP))
    space = SearchSpace(figures=3)
    search = gradopt(surrogate, space, schedule=Schedule.stretched(40), restarts=2, seed=0)
    _, by_chance = random_search(surrogate, space, patterns=80, seed=5)
    assert (search.best.amax(1) > by_chance).all()


def test_a_result_is_the_same_when_loaded(tmp_path):
    result = attack(
        recording_set(), pull_to_the_right(), SearchSpace(figures=2), schedule=HEATED, restarts=2, random_patterns=4
    )
    result.save(tmp_path)
    loaded = AttackResult.load(tmp_path)
    torch.testing.assert_close(loaded.pattern.boxes, result.pattern.boxes)
    np.testing.assert_allclose(loaded.history, result.history, atol=1e-6)
    for name in ("group", "surrogate_shift", "by_group", "stopped", "cost", "checks", "space", "schedule", "seed"):
        assert getattr(loaded, name) == getattr(result, name), name


def test_a_controller_for_other_frames_or_one_that_answers_nan_is_refused():
    controller = pull_to_the_right()
    controller.input_size = (66, 200)
    with pytest.raises(ControllerError, match="takes frames of 200×66"):
        Surrogate(recording_set(), controller, (RIGHT_GROUP,))
    with pytest.raises(ControllerError, match="NaN"):
        Surrogate(recording_set(), LinearController(torch.full((3, 88, 200), torch.nan)), (RIGHT_GROUP,))


@pytest.mark.parametrize("kwargs", [{"iterations": 0}, {"learning_rate": 0.0}])
def test_schedules_that_make_no_sense_are_refused(kwargs):
    with pytest.raises(RoadproofError):
        Schedule(**kwargs)


def test_restarts_must_be_at_least_one_and_heats_must_leave_as_many():
    run = lambda restarts: attack(  # noqa: E731
        recording_set(), pull_to_the_right(), SearchSpace(figures=1), schedule=HEATED, restarts=restarts
    )
    with pytest.raises(RoadproofError, match="restarts is 0"):
        run(0)
    with pytest.raises(RoadproofError, match="fewer than 5 restarts"):
        run(5)
    with pytest.raises(RoadproofError, match="number below 1"):
        Heat(starts=4, iterations=2, every=0)


def test_the_published_schedule_is_the_papers():
    schedule = Schedule()
    assert [round(schedule.rate(i), 6) for i in (0, 99, 100, 199, 200, 249)] == [0.1, 0.1, 0.01, 0.01, 0.001, 0.001]
    assert Schedule.stretched(250) == schedule == Schedule.stretched()
    assert not schedule.heats

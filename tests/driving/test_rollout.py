"""Rollouts in the town itself, and episodes on disk."""

import dataclasses
import inspect
import json

import numpy as np
import pytest
import torch

import needs
from roadproof.controllers import Controller
from roadproof.coverage import Shape
from roadproof.datatypes import Control, Ending, Event, EventKind, Weather
from roadproof.driving.episode import Episode
from roadproof.driving.rollout import drive_again, look_again, replay, rollout
from roadproof.errors import ControllerError, EpisodeError, OutputError, PatternError, SimulatorError
from roadproof.patterns import Pattern, raster
from roadproof.scenarios import find_scenario

needs.town()
from roadproof.training.expert import expert

LEFT = find_scenario("left-03")
SHORT = dataclasses.replace(LEFT, time_limit_s=2.0)
PATTERN = Pattern((Shape.RECTANGLE,), torch.tensor([[200.0, 200.0, 300.0, 300.0, 0.0]]), torch.ones(1, 3))


class Straight:
    """A controller that keeps its wheel where it is told."""

    input_size = (88, 200)

    def __init__(self, steer=0.0):
        self.seen = []
        self._steer = steer

    def steer(self, frames, speed_mps, command):
        return torch.full((len(frames),), self._steer)

    def act(self, frame, speed_mps, command):
        self.seen.append((frame, speed_mps, command))
        return Control(self._steer, throttle=0.6)


@pytest.fixture(scope="module")
def episode(town):
    return rollout(town, Straight(0.1), SHORT, weather=Weather.CLOUDY_NOON, seed=7)


def same(one, two):
    return all(np.array_equal(getattr(one, f.name), getattr(two, f.name)) for f in dataclasses.fields(Episode))


def test_the_expert_reaches_the_goal_and_the_episode_says_so(town):
    episode = rollout(town, expert, LEFT)
    assert episode.ending is Ending.GOAL_REACHED
    assert episode.events == ()
    assert (episode.scenario, episode.weather, episode.painted) == ("left-03", Weather.CLEAR_NOON, False)
    assert np.hypot(episode.x_m[-1] - LEFT.goal_m[0], episode.y_m[-1] - LEFT.goal_m[1]) < 3.0
    assert (episode.x_m[0], episode.y_m[0]) == (LEFT.start.x_m, LEFT.start.y_m)


def test_an_episode_holds_n_observations_and_the_controls_between_them(town):
    told = []
    controller = Straight(0.1)
    assert isinstance(controller, Controller)
    episode = rollout(
        town, controller, SHORT, on_step=lambda seen, control: told.append((seen, control, town.state.x_m))
    )
    assert episode.ending is Ending.TIME_LIMIT
    assert len(episode) == 41 == len(told)
    np.testing.assert_allclose(episode.time_s, 0.05 * np.arange(41), atol=1e-9)
    np.testing.assert_array_equal(episode.steer, np.full(40, 0.1))
    assert [control for _, control, _ in told] == [Control(0.1, throttle=0.6)] * 40 + [None]
    # The step's observation, what the controller saw, the simulator's state and the episode's row are of one instant.
    assert [seen.state.x_m for seen, _, _ in told] == episode.x_m.tolist() == [x for _, _, x in told]
    assert [speed for _, speed, _ in controller.seen] == episode.speed_mps[:-1].tolist()
    assert all(
        np.array_equal(one, seen.frame) for (one, _, _), (seen, _, _) in zip(controller.seen, told, strict=False)
    )
    assert [command for _, _, command in controller.seen] == episode.command[:-1].tolist()


def test_a_controller_is_asked_with_one_thread_and_the_others_come_back(town, two_threads):
    class Counts(Straight):
        def act(self, frame, speed_mps, command):
            self.seen.append(torch.get_num_threads())
            if len(self.seen) == 3:
                raise ValueError("enough")
            return Control(0.0)

    driver = Counts()
    with pytest.raises(ControllerError, match="enough"):
        rollout(town, driver, SHORT)
    assert driver.seen == [1, 1, 1]
    assert torch.get_num_threads() == 2


def test_the_same_seed_gives_the_same_episode_and_another_seed_other_people(town, episode):
    assert same(episode, rollout(town, Straight(0.1), SHORT, weather=Weather.CLOUDY_NOON, seed=7))

    def met(seed):
        places = []
        rollout(town, expert, SHORT, cars=5, pedestrians=5, seed=seed,
                on_step=lambda *_: places.append(town.pedestrians.x_m.tolist()))  # fmt: skip
        return places

    assert met(1) == met(1) != met(2)


def test_a_replay_drives_the_same_way_over_a_painted_road(town, episode):
    bare, painted = [], []
    again = rollout(town, replay(episode), SHORT, on_step=lambda seen, _: bare.append(seen.frame))
    over = rollout(town, replay(episode), SHORT, pattern=PATTERN, on_step=lambda seen, _: painted.append(seen.frame))
    for name in ("x_m", "y_m", "yaw_rad", "speed_mps", "steer"):
        assert np.array_equal(getattr(again, name), getattr(episode, name))
        assert np.array_equal(getattr(over, name), getattr(episode, name))
    assert over.painted
    assert any((one != two).any() for one, two in zip(bare, painted, strict=True))


def test_a_drive_stops_where_it_is_told_to(town):
    stopped = rollout(town, Straight(0.1), SHORT, until=lambda seen: seen.time_s >= 0.5 - 1e-9)
    assert stopped.ending is Ending.STOPPED
    assert len(stopped) == 11
    assert rollout(town, Straight(0.1), SHORT, until=lambda _: True).steer.size == 0


def test_a_replay_brakes_after_its_last_control(town, episode):
    longer = dataclasses.replace(SHORT, time_limit_s=3.0)
    again = rollout(town, replay(episode), longer)
    assert again.brake[40:].tolist() == [1.0] * 20
    assert again.speed_mps[-1] < episode.speed_mps[-1]


def test_a_pattern_and_its_raster_are_the_same_paint(town):
    def last_frame(pattern):
        frames = []
        rollout(town, expert, SHORT, pattern=pattern, on_step=lambda seen, _: frames.append(seen.frame))
        return frames[-1]

    np.testing.assert_array_equal(last_frame(PATTERN), last_frame(raster(PATTERN)))


def test_a_driver_that_writes_into_its_pictures_changes_nobody_elses(town, episode):
    class Masked(Straight):
        def act(self, frame, speed_mps, command):
            frame[:] = 0
            return super().act(frame, speed_mps, command)

    def masked(world):
        def policy(seen):
            seen.frame[:], seen.picture[:] = 0, 0
            return Control(0.1, throttle=0.6)

        return policy

    shown = []
    given = {"weather": Weather.CLOUDY_NOON, "seed": 7, "on_step": lambda seen, control: shown.append(seen.shown)}
    assert same(rollout(town, Masked(0.1), SHORT, **given), episode)
    rollout(town, masked, SHORT, full_pictures=True, **given)
    assert all(each.any() for each in shown)


def test_controls_are_kept_inside_their_range(town):
    episode = rollout(town, lambda _: lambda _: Control(-7.0, throttle=2.0, brake=-1.0), SHORT)
    assert set(episode.steer) == {-1.0}
    assert set(episode.throttle) == {1.0}
    assert set(episode.brake) == {0.0}


def test_full_pictures_are_shown_where_they_are_asked_for(town):
    shown = []
    very_short = dataclasses.replace(LEFT, time_limit_s=0.1)
    rollout(town, expert, very_short, full_pictures=True, on_step=lambda seen, _: shown.append(seen.picture.shape))
    assert shown == [(600, 800, 3)] * 3
    rollout(town, expert, very_short, full_pictures=frozenset({1}), on_step=lambda seen, _: shown.append(seen.picture))
    assert [picture is not None for picture in shown[3:]] == [False, True, False]


def test_frames_that_nobody_asks_for_are_black_and_the_others_are_the_same(town):
    def frames_of(**asked):
        frames, busy = [], {"cars": 5, "pedestrians": 5, "seed": 1, "weather": Weather.RAINY_NOON}
        keep = lambda seen, _: frames.append(seen.frame)  # noqa: E731
        rollout(town, expert, SHORT, pattern=PATTERN, on_step=keep, **busy, **asked)
        return np.stack(frames)

    whole, some, none = frames_of(), frames_of(frames=frozenset({0, 7, 30})), frames_of(frames=False)
    assert np.flatnonzero(some.any((1, 2, 3))).tolist() == [0, 7, 30]
    np.testing.assert_array_equal(some[[0, 7, 30]], whole[[0, 7, 30]])
    assert not none.any()


@pytest.mark.parametrize("frames", [False, frozenset({0, 7})], ids=str)
def test_a_controller_is_never_driven_by_black_frames(town, frames):
    driver = Straight()
    with pytest.raises(
        SimulatorError, match=r"^a controller drives by every frame, [^\n]* `frames` is not True; [^\n]*$"
    ):
        rollout(town, driver, SHORT, frames=frames)
    assert driver.seen == []


def test_a_drive_is_looked_at_again_only_where_it_is_asked_for(town):
    episode, frames = rollout(town, expert, SHORT), []
    seen = look_again(town, episode, SHORT, (3, 9), lambda seen: (seen.frame.any(), seen.picture is None))
    assert seen == {3: (True, True), 9: (True, True)}
    seen = look_again(town, episode, SHORT, (3,), lambda seen: seen.shown.shape, full_pictures=True)
    assert seen == {3: (600, 800, 3)}
    four = {"looked_at": frozenset({4}), "full_pictures": True}
    drive_again(town, episode, SHORT, **four, on_step=lambda seen, _: frames.append(seen.frame.any()))
    assert frames == [False] * 5


class Blind:
    """The town without full pictures."""

    def __init__(self, town):
        self._town = town

    def __getattr__(self, name):
        return getattr(self._town, name)

    def reset(self, scenario, **options):
        return self._town.reset(scenario, **options | {"full_pictures": False})


def test_a_full_picture_that_is_looked_at_and_does_not_come_is_named(town):
    episode = rollout(town, expert, SHORT)
    with pytest.raises(
        SimulatorError, match=r"^the simulator gave no full picture at step 3, .*check_simulator[^\n]*$"
    ):
        look_again(Blind(town), episode, SHORT, (3,), lambda seen: seen.shown, full_pictures=True)
    assert look_again(Blind(town), episode, SHORT, (3,), lambda seen: seen.shown.any()) == {3: True}


def test_a_simulator_that_is_not_told_which_frames_are_wanted_is_refused_before_its_first_drive(town):
    class Earlier(Blind):
        def reset(self, scenario, *, weather, pattern, cars, pedestrians, seed, full_pictures):
            raise AssertionError("begun")

    class Compiled:
        """Does not say what it takes, as code in C need not."""

        @property
        def __signature__(self):
            raise ValueError("no signature")

        def __call__(self, scenario, **options):
            return town.reset(scenario, **options)

    with pytest.raises(SimulatorError, match=r"^reset of Earlier takes no keyword `frames`, [^\n]* add it, [^\n]*$"):
        rollout(Earlier(town), expert, SHORT)
    compiled = Blind(town)
    compiled.reset = Compiled()
    with pytest.raises(ValueError, match="no signature"):
        inspect.signature(compiled.reset)
    assert len(rollout(compiled, Straight(), SHORT)) == 41


def test_what_a_driver_gets_wrong_is_named(town):
    class Large(Straight):
        input_size = (66, 200)

    with pytest.raises(ControllerError, match="takes frames of 200×66, the simulator gives 200×88"):
        rollout(town, Large(), SHORT)
    with pytest.raises(ControllerError, match=r"act failed at .*test_rollout\.py:\d+: control steer is nan"):
        rollout(town, Straight(float("nan")), SHORT)
    with pytest.raises(ControllerError, match=r"the driver failed at .*test_rollout\.py:\d+: control steer is nan"):
        rollout(town, lambda _: lambda _: Control(float("nan")), SHORT)
    with pytest.raises(ControllerError, match=r"answered 0\.5, expected a roadproof"):
        rollout(town, lambda _: lambda _: 0.5, SHORT)


def test_a_pattern_that_does_not_fit_is_named(town):
    batch = Pattern(PATTERN.shapes, PATTERN.boxes[None], PATTERN.colours[None])
    with pytest.raises(PatternError, match="one pattern, got a batch"):
        rollout(town, expert, SHORT, pattern=batch)


def test_an_episode_survives_its_file(tmp_path, episode):
    eventful = dataclasses.replace(
        episode, events=(Event(EventKind.SIDEWALK, 1.5, "a wheel, 0.2 m"), Event(EventKind.OFF_ROAD, 1.9))
    )
    path = tmp_path / "new" / "drive.episode"
    eventful.save(path)
    assert same(Episode.load(path), eventful)
    assert path.stat().st_size < 12_000
    assert [one.name for one in path.parent.iterdir()] == ["drive.episode"]


def test_an_episode_file_explains_itself(tmp_path, episode):
    episode.save(tmp_path / "one.npz")
    with np.load(tmp_path / "one.npz", allow_pickle=False) as stored:
        header = json.loads(str(stored["header"]))
        assert set(header["units"]["steer"].split()) > {"positive", "right,"}
        assert header["weather"] == "cloudy-noon"
        assert header["ending"] == "time limit"
        np.testing.assert_array_equal(stored["x_m"], episode.x_m)


def rewritten(path, change):
    with np.load(path, allow_pickle=False) as stored:
        content = dict(stored)
    header = json.loads(str(content["header"]))
    change(header, content)
    np.savez(path, **content | {"header": np.array(json.dumps(header))})


DAMAGE = {
    "has format 'other', expected 'roadproof-episode'": lambda header, _: header.update(format="other"),
    "has version 9, this roadproof reads up to 1; update it": lambda header, _: header.update(version=9),
    "required field `ending`": lambda header, _: header.pop("ending"),
    "ending: Invalid enum value 'bored'": lambda header, _: header.update(ending="bored"),
    "weather: Invalid enum value 'dry'": lambda header, _: header.update(weather="dry"),
    "it has no brake": lambda _, content: content.pop("brake"),
    "x_m of the episode has NaN": lambda _, content: content.update(x_m=content["x_m"] * np.nan),
    "steer of the episode has shape \\(39,\\), expected \\(40,\\)": lambda _, content: content.update(
        steer=content["steer"][1:]
    ),
}


@pytest.mark.parametrize("message", DAMAGE)
def test_a_damaged_file_is_refused_by_name(tmp_path, episode, message):
    path = tmp_path / "one.npz"
    episode.save(path)
    rewritten(path, DAMAGE[message])
    with pytest.raises(EpisodeError, match=message):
        Episode.load(path)


def test_what_is_no_episode_is_refused(tmp_path, episode):
    with pytest.raises(EpisodeError, match="nowhere is missing; check the path"):
        Episode.load(tmp_path / "nowhere")
    path = tmp_path / "one.npz"
    episode.save(path)
    for content in (path.read_bytes()[:500], b"", b"text"):
        path.write_bytes(content)
        with pytest.raises(EpisodeError, match="is damaged"):
            Episode.load(path)
    np.savez(path, x=np.zeros(3))
    with pytest.raises(EpisodeError, match=r"is damaged \(it has no header\)"):
        Episode.load(path)


def test_an_episode_that_cannot_be_written_is_an_output_error(tmp_path, episode):
    (tmp_path / "file").write_text("")
    with pytest.raises(OutputError, match="cannot write"):
        episode.save(tmp_path / "file" / "one.npz")

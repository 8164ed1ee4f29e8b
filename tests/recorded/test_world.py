"""Driving in recordings: the clean drive holds, batches are their parts, gradients are those of the loop."""

import dataclasses

import numpy as np
import pytest
import torch

from painted_ground import CANVAS, RampFollower, recorded, recorded_road
from roadproof.coverage import Shape
from roadproof.errors import RecordingError, SimulatorError
from roadproof.patterns import Pattern
from roadproof.recorded.course import Course
from roadproof.recorded.vehicle import Vehicle
from roadproof.recorded.world import UNSURE, BiasedStart, RecordedWorld
from roadproof.recordings import Side
from roadproof.recordings.recording import PER_FRAME

VEHICLE = dataclasses.replace(
    Vehicle.bicycle(wheelbase_m=2.8, steer_range_rad=0.7, dt_s=0.1), pulling=(4.0, -8.0, -0.4, 0.0, 0.0)
)


@pytest.fixture(scope="module")
def world():
    made = RecordedWorld(recorded_road(), vehicle=VEHICLE)
    made.fit(RampFollower())
    return made


def painted(*rows):
    """A batch of patterns of one rectangle each: x px, width px, brightness."""
    boxes = torch.tensor([[[x, 200.0, width, 380.0, 0.0]] for x, width, _ in rows])
    colours = torch.tensor([[[level] * 3] for _, _, level in rows])
    return Pattern((Shape.RECTANGLE,), boxes, colours)


def test_the_bare_road_is_driven_as_it_was_recorded(world):
    rolled = world.roll(RampFollower())
    assert rolled.right_m.abs().max() < 0.05
    path = world.whole_path(rolled, 0)
    assert np.abs(path[:, 1] - CANVAS.y_m).max() < 0.05
    assert np.diff(path[:, 0]).min() > 0.4


def test_a_car_that_starts_aside_is_brought_back(world):
    rolled = world.roll(
        RampFollower(), starts=(BiasedStart(right_m=0.5), BiasedStart(right_m=-0.5), BiasedStart(turned_rad=0.03))
    )
    assert rolled.right_m[:2, 0].tolist() == pytest.approx([0.5, -0.5])
    assert (rolled.right_m[:2, -1].abs() < 0.35).all()
    # Turned to the left it goes to the left first.
    assert rolled.right_m[2, 5] < -0.02


def test_a_car_whose_steering_is_off_goes_its_way_and_no_further(world):
    right, left = world.roll(RampFollower(), starts=(BiasedStart(steer=0.02), BiasedStart(steer=-0.02))).right_m
    # It drifts until the controller answers with as much the other way.
    assert right[-1] > 0.03
    assert left[-1] < -0.03
    assert right.abs().max() < 0.5


def test_a_prediction_has_a_value_for_every_start(world):
    found = world.predict(RampFollower(), painted((200, 300, 1.0), (200, 5, 0.43)), UNSURE).deviation_m
    assert found.shape == (2, len(UNSURE))
    alone = world.predict(RampFollower(), painted((200, 300, 1.0))).deviation_m
    assert found[0, UNSURE.index(BiasedStart())] == pytest.approx(alone[0, 0], abs=1e-6)
    # Against the bare road with the same error: thin grey paint does next to nothing.
    assert found[1].max() < 0.1


def test_a_controller_that_only_steers_drives_off_where_the_clean_drive_stood_first():
    drives = (recorded(stands=12), recorded(Side.RIGHT, -1.5), recorded(Side.LEFT, 1.5))
    world = RecordedWorld(dataclasses.replace(recorded_road(), recordings=drives), vehicle=VEHICLE)
    world.fit(RampFollower())
    rolled = world.roll(RampFollower())
    assert float(rolled.speed_mps[0, 0]) == 0
    clean = world.course.poses.x_m[world.course.seen.stop - 1] + CANVAS.x_m
    # The same way in the same time, but for the stand, which a law of place cannot know.
    assert float(rolled.speed_mps[0, -1]) == pytest.approx(6.0, abs=0.4)
    assert float(rolled.x_m[0, -1]) > float(clean) - 1.0


def test_bright_paint_pulls_to_the_right_and_dark_paint_to_the_left(world):
    bright, dark = world.roll(RampFollower(), painted((200, 300, 1.0), (200, 300, 0.0))).right_m
    assert bright.max() > 0.3
    assert dark.min() < -0.1
    deviations = world.predict(RampFollower(), painted((200, 300, 1.0), (200, 5, 0.43))).deviation_m[:, 0]
    assert deviations[0] > 5 * deviations[1]


def test_figures_of_several_shapes_are_driven_over_as_those_of_one(world):
    boxes = torch.tensor([[[150.0, 200.0, 80.0, 380.0, 0.0], [260.0, 200.0, 60.0, 380.0, 0.0]]]).repeat(2, 1, 1)
    colours = torch.tensor([[[1.0] * 3, [0.0] * 3]]).repeat(2, 1, 1)
    with torch.no_grad():
        mixed, alike = (
            world.roll(RampFollower(), Pattern(shapes, boxes, colours)).right_m
            for shapes in ((Shape.RECTANGLE, Shape.ELLIPSE), (Shape.RECTANGLE, Shape.RECTANGLE))
        )
    assert mixed.shape == alike.shape
    assert torch.allclose(mixed[0], mixed[1], atol=1e-6)
    # A drive over the other order of figures that do not overlap is the same.
    swapped = Pattern((Shape.ELLIPSE, Shape.RECTANGLE), boxes.flip(1), colours.flip(1))
    with torch.no_grad():
        assert torch.allclose(world.roll(RampFollower(), swapped).right_m, mixed, atol=2e-3)
    assert (mixed - alike).abs().max() > 1e-3


def test_a_car_begins_with_its_wheels_where_they_were_not_where_they_were_told_to_be():
    road = recorded_road()
    clean = road.clean
    first = int(clean.track.rows(clean.frame_number[:1])[0])
    steer = clean.track.steer.copy()
    steer[first - 1] += 0.6
    jumped = dataclasses.replace(clean, track=dataclasses.replace(clean.track, steer=steer))
    made = RecordedWorld(
        dataclasses.replace(road, recordings=(jumped, *road.recordings[1:])),
        vehicle=dataclasses.replace(VEHICLE, steer_rate_per_s=2.0),
    )
    assert float(made.begin().steer) == pytest.approx(
        float(clean.track.steer[first - 2]) + 2.0 * VEHICLE.dt_s, abs=0.02
    )


def test_a_batch_is_its_parts_and_the_same_twice(world):
    rows, starts = ((150, 80, 1.0), (260, 60, 0.0)), (BiasedStart(), BiasedStart(right_m=0.3))
    with torch.no_grad():
        together = world.roll(RampFollower(), painted(*rows), starts=starts)
        again = world.roll(RampFollower(), painted(*rows), starts=starts)
        apart = [world.roll(RampFollower(), painted(row), starts=(start,)) for row in rows for start in starts]
    assert torch.equal(together.right_m, again.right_m)
    assert torch.allclose(together.right_m, torch.cat([each.right_m for each in apart]), atol=2e-3)


def test_cars_go_on_from_the_drive_up_to_the_canvas_as_if_they_had_driven_all_the_way(world):
    rows, starts = ((150, 80, 1.0), (260, 60, 0.0)), (BiasedStart(), BiasedStart(right_m=0.3))
    after = world.approach(RampFollower(), starts, every=2)
    assert after is not None
    assert 0 < after.step < world.course.count and after.step % 2 == 0
    with torch.no_grad():
        whole = world.roll(RampFollower(), painted(*rows), starts=starts, every=2)
        gone_on = world.roll(RampFollower(), painted(*rows), starts=starts, every=2, after=after)
        bare = world.roll(RampFollower(), starts=starts, every=2)
        # Over the bare road nothing can tell where the drive was cut, to the last digit of a smaller batch.
        again = world.roll(RampFollower(), starts=starts, every=2, after=after)
    assert torch.equal(again.right_m, bare.right_m)
    assert torch.equal(gone_on.right_m[:, : after.step], bare.right_m[:, : after.step].repeat(2, 1))
    assert (gone_on.right_m - bare.right_m.repeat(2, 1)).abs().amax(1).min() > 0.1
    # What is left out is paint on less than a hundredth of a picture.
    assert float((gone_on.right_m - whole.right_m).abs().max()) < 0.05 * float(whole.right_m.abs().max())


def test_a_controller_that_remembers_drives_all_the_way(world):
    assert world.approach(Smoothed(), (BiasedStart(),)) is None


def test_gradients_of_a_drive_on_one_picture_are_central_differences(world):
    """Same start and frame: the loop is open, so that the gradient through the paint is all there is."""
    once = world.course.count

    def aside(x, level):
        boxes = torch.stack([x, x.new_tensor(200.0), x.new_tensor(90.0), x.new_tensor(300.0), x.new_tensor(10.0)])
        pattern = Pattern((Shape.RECTANGLE,), boxes[None, None], level.expand(1, 1, 3))
        return world.roll(RampFollower(), pattern, every=once).right_m.mean()

    x, level = torch.tensor(170.0, requires_grad=True), torch.tensor(0.8, requires_grad=True)
    slopes = torch.autograd.grad(aside(x, level), (x, level))
    with torch.no_grad():
        by_x = (aside(x + 2.0, level) - aside(x - 2.0, level)) / 4.0
        by_level = (aside(x, level + 0.02) - aside(x, level - 0.02)) / 0.04
    assert float(slopes[0]) == pytest.approx(float(by_x), rel=0.05, abs=1e-6)
    assert float(slopes[1]) == pytest.approx(float(by_level), rel=0.02)


def test_gradients_through_the_loop_point_where_the_car_goes(world):
    level = torch.tensor(0.5, requires_grad=True)

    def aside(value):
        pattern = painted((200, 60, 1.0))
        return world.roll(RampFollower(), Pattern(pattern.shapes, pattern.boxes, value.expand(1, 1, 3))).right_m.mean()

    (slope,) = torch.autograd.grad(aside(level), level)
    with torch.no_grad():
        measured = (aside(level + 0.05) - aside(level - 0.05)) / 0.1
    assert float(slope) == pytest.approx(float(measured), rel=0.5)


def test_the_gap_says_how_far_the_pictures_are_from_recorded_ones(world):
    rolled = world.roll(RampFollower(), starts=(BiasedStart(right_m=0.6),))
    assert float(rolled.left_m[0, 0]) == pytest.approx(-0.6, abs=1e-6)


@pytest.mark.parametrize(
    "pulling", [(1e9, -8.0, 1e3, 0.0, 0.0), (float("nan"), -8.0, 0.0, 0.0, 0.0)], ids=["far", "NaN"]
)
def test_a_car_that_leaves_all_bounds_is_one_clear_line(pulling):
    wild = dataclasses.replace(VEHICLE, pulling=pulling, curving=(0.9, 1e3, 0.0, 0.0))
    world = RecordedWorld(recorded_road(every=2), vehicle=wild)
    world.fit(RampFollower())
    with pytest.raises(RecordingError, match="a car leaves all bounds in these recordings"):
        world.roll(RampFollower())


def test_sets_too_thin_to_drive_in_are_one_clear_line():
    aside = recorded(Side.RIGHT, -1.0, every=8)
    road = recorded_road(every=8)
    with pytest.raises(RecordingError, match="no clean drive"):
        RecordedWorld(dataclasses.replace(road, recordings=(aside,)), vehicle=VEHICLE)
    clean = recorded(every=8)
    few = dataclasses.replace(
        clean.track,
        **{field.name: getattr(clean.track, field.name)[:2] for field in dataclasses.fields(clean.track)[1:]},
    )
    with pytest.raises(RecordingError, match="no pose for frame"):
        dataclasses.replace(clean, track=few)
    behind = dataclasses.replace(CANVAS, x_m=float(clean.track.x_m[0]), y_m=float(clean.track.y_m[0]))
    with pytest.raises(
        RecordingError, match=r"the clean drive's first frame, of step \d+, comes after the canvas' end"
    ):
        Course(clean.track, behind, int(clean.track.step[-1]))
    with pytest.raises(SimulatorError, match=r"the vehicle has steps of 0\.05 s, the recordings have 0\.1 s"):
        RecordedWorld(road, vehicle=dataclasses.replace(VEHICLE, dt_s=0.05))


def without(drive, steps):
    """A drive whose log lost some steps."""
    kept, shown = ~np.isin(drive.track.step, steps), ~np.isin(drive.frame_number, steps)
    known = {field.name: getattr(drive.track, field.name)[kept] for field in dataclasses.fields(drive.track)[1:]}
    frames = {name: getattr(drive, name)[shown] for name in ("frames", *PER_FRAME)}
    return dataclasses.replace(drive, track=dataclasses.replace(drive.track, **known), **frames)


def test_steps_that_the_clean_log_lost_end_no_drive(world):
    road = recorded_road()
    clean, *others = road.recordings

    def course(lost):
        known = dataclasses.replace(road, recordings=(without(clean, lost), *others))
        return RecordedWorld(known, vehicle=VEHICLE).course

    # A long gap before the first frame, which is step 6, is not on the way.
    for lost in ([30], [30, 31, 40], range(1, 6)):
        whole, found = (each.poses.x_m[each.first :][: each.count] for each in (world.course, course(lost)))
        assert found.tolist() == pytest.approx(whole.tolist())
    with pytest.raises(RecordingError, match="lacks steps 30 to 35, between its first frame and the canvas' end"):
        course(range(30, 36))


class Smoothed(RampFollower):
    """Steers by the mean of what it would do at this picture and at the one before."""

    def __init__(self):
        super().__init__()
        self.elapsed = []

    def controls_after(self, memory, frames, speed_mps, command, elapsed_s):
        now = self.steer(frames, speed_mps, command)
        self.elapsed.append(elapsed_s)
        pedals = torch.zeros(len(frames), 2)
        pedals[:, 0] = 0.1
        steer = 0.5 * (now + (now if memory is None else memory))
        return torch.cat([steer.clamp(-1.0, 1.0)[:, None], pedals], 1), now


def test_what_a_controller_remembers_is_of_the_drive_so_far(world):
    controller, patterns = Smoothed(), painted((200, 60, 1.0), (120, 60, 0.0))
    rolled = world.roll(controller, patterns)
    dt_s = world.vehicle.dt_s
    assert controller.elapsed == [0.0] + [dt_s] * (world.course.count - 1)
    # The cars of a batch remember their own drives.
    for k in range(2):
        alone = world.roll(Smoothed(), _one(patterns, k))
        torch.testing.assert_close(rolled.steer[k], alone.steer[0], atol=1e-5, rtol=1e-4)
    # With a picture every third step as much time has passed between two.
    controller.elapsed.clear()
    world.roll(controller, every=3)
    assert controller.elapsed[:3] == [0.0, 3 * dt_s, 3 * dt_s]
    # The memory is what it should be: steering at a step is the mean of two answers.
    bare = world.roll(RampFollower())
    assert not torch.allclose(bare.steer, world.roll(Smoothed()).steer)


def _one(patterns, k):
    return Pattern(patterns.shapes, patterns.boxes[k : k + 1], patterns.colours[k : k + 1])


def test_gradients_reach_paint_that_is_only_remembered(world):
    """A controller that steers by the picture before alone: its gradient is that of the loop all the same."""

    class Late(Smoothed):
        def controls_after(self, memory, frames, speed_mps, command, elapsed_s):
            now = self.steer(frames, speed_mps, command)
            controls = torch.zeros(len(frames), 3)
            controls[:, 0] = (now if memory is None else memory).clamp(-1.0, 1.0)
            return controls, now

    level = torch.tensor(0.5, requires_grad=True)

    def aside(value):
        pattern = painted((200, 60, 1.0))
        return world.roll(Late(), Pattern(pattern.shapes, pattern.boxes, value.expand(1, 1, 3))).right_m.mean()

    (slope,) = torch.autograd.grad(aside(level), level)
    with torch.no_grad():
        measured = (aside(level + 0.05) - aside(level - 0.05)) / 0.1
    assert float(slope) == pytest.approx(float(measured), rel=0.5)

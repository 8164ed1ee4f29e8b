import dataclasses

import numpy as np
import pytest

import needs
from roadproof.datatypes import Control, VehicleState
from roadproof.scenarios import find_scenario

needs.town()
from roadproof.simulators.checks import check_simulator

SCENARIO = find_scenario("straight-01")


class Altered:
    """The town with one thing broken."""

    def __init__(self, town):
        self._town, self._resets = town, 0

    def __getattr__(self, name):
        return getattr(self._town, name)

    def altered(self, seen):
        return seen

    def reset(self, scenario, **options):
        self._resets += 1
        return self.altered(self._town.reset(scenario, **options))

    def step(self, control):
        return self.altered(self._town.step(control))


class SteersTheOtherWay(Altered):
    def step(self, control):
        return super().step(Control(-control.steer, control.throttle, control.brake))


class GivesFloats(Altered):
    def altered(self, seen):
        # Past the frozen dataclass' own check, as a simulator without type checks would.
        broken = dataclasses.replace(seen)
        object.__setattr__(broken, "frame", seen.frame / 255)
        return broken


class CountsStepsNotSeconds(Altered):
    def altered(self, seen):
        return dataclasses.replace(seen, time_s=seen.time_s * 20)


class ShowsKilometresPerHour(Altered):
    def altered(self, seen):
        return dataclasses.replace(seen, state=dataclasses.replace(seen.state, speed_mps=seen.state.speed_mps * 3.6))


class HasNoise(Altered):
    def altered(self, seen):
        noise = np.random.default_rng(self._resets).integers(0, 2, seen.frame.shape).astype(np.uint8)
        return dataclasses.replace(seen, frame=np.maximum(seen.frame, 1) - noise)


class KeepsThePaint(Altered):
    kept = None

    def reset(self, scenario, **options):
        if options.get("pattern") is not None:
            self.kept = options["pattern"]
        return super().reset(scenario, **{**options, "pattern": self.kept})


class MirrorsTheCanvas(Altered):
    def reset(self, scenario, **options):
        if options.get("pattern") is not None:
            options["pattern"] = np.ascontiguousarray(options["pattern"][:, ::-1])
        return super().reset(scenario, **options)


class HasAnotherPixelCentre(Altered):
    def image_from_canvas(self):
        shift = np.array([[1.0, 0.0, 0.5], [0.0, 1.0, 0.5], [0.0, 0.0, 1.0]])
        return shift @ self._town.image_from_canvas()


class ShowsGamma(Altered):
    def altered(self, seen):
        if seen.picture is None:
            return seen
        curve = (255 * (np.arange(256) / 255) ** 2.2).astype(np.uint8)
        return dataclasses.replace(seen, picture=curve[seen.picture], frame=curve[seen.frame])


class StartsElsewhere(Altered):
    def reset(self, scenario, **options):
        start = scenario.start
        moved = VehicleState(start.x_m + 1.0, start.y_m, start.z_m, start.yaw_rad, start.speed_mps)
        return super().reset(dataclasses.replace(scenario, start=moved), **options)


class ShowsTheFrameBefore(Altered):
    """Where not all frames are asked for, each comes a step late."""

    def reset(self, scenario, **options):
        self.is_late, self.before = options.get("frames", True) is not True, None
        return super().reset(scenario, **options)

    def altered(self, seen):
        before, self.before = self.before, seen.frame
        return dataclasses.replace(seen, frame=before) if self.is_late and before is not None else seen


class ShowsPicturesWithFramesAlone(Altered):
    """A full picture comes only where its frame is asked for too."""

    def reset(self, scenario, **options):
        self.blind = not options.get("frames", True)
        return super().reset(scenario, **options)

    def altered(self, seen):
        return dataclasses.replace(seen, picture=None) if self.blind else seen


class ShowsPicturesOfNothing(ShowsPicturesWithFramesAlone):
    def altered(self, seen):
        if seen.picture is None or not self.blind:
            return seen
        return dataclasses.replace(seen, picture=np.zeros_like(seen.picture))


class Crashes(Altered):
    def step(self, control):
        raise RuntimeError("lost the connection")


def test_the_town_passes(town):
    report = check_simulator(town, SCENARIO, steps=10)
    assert report.passed, str(report)
    assert str(report).endswith("all checks passed")
    assert len({check.name for check in report.checks}) == len(report.checks) == 14


@pytest.mark.parametrize(
    ("broken", "name"),
    [
        (SteersTheOtherWay, "steering"),
        (GivesFloats, "observation"),
        (CountsStepsNotSeconds, "clock"),
        (ShowsKilometresPerHour, "units"),
        (HasNoise, "determinism"),
        (KeepsThePaint, "reset"),
        (MirrorsTheCanvas, "paint"),
        (HasAnotherPixelCentre, "homography"),
        (ShowsGamma, "colours"),
        (StartsElsewhere, "start"),
        (ShowsTheFrameBefore, "frames"),
        (ShowsPicturesWithFramesAlone, "frames"),
        (ShowsPicturesOfNothing, "frames"),
        (Crashes, "clock"),
    ],
    ids=lambda value: getattr(value, "__name__", value),
)
def test_a_broken_simulator_fails_the_check_that_names_the_fault(town, broken, name):
    report = check_simulator(broken(town), SCENARIO, steps=8, only=[name])
    assert [(check.name, check.passed) for check in report.checks] == [(name, False)], str(report)
    assert str(report).endswith("1 of 1 checks failed")

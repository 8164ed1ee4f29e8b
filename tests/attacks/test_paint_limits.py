"""Whatever the search, what it finds obeys the limits on paint."""

from __future__ import annotations

import sys
from dataclasses import replace
from functools import partial

import numpy as np
import pytest
import torch

from recorded_drives import CANVAS, PLAIN, drivable_set
from roadproof.attacks import (
    METHODS,
    GradOpt,
    PathDeviation,
    Published,
    SteeringShift,
    attack,
    cheapest,
    method_of,
    proposals,
)
from roadproof.attacks.groups import RIGHT_GROUP
from roadproof.attacks.result import AttackResult
from roadproof.attacks.site import _flat, site_of
from roadproof.errors import PatternError
from roadproof.paint import LaneMark, PaintLimits, conspicuousness
from roadproof.photometry import AffineResponse, ColourTransform
from roadproof.search_space import SearchSpace
from scenes import recording_set

MARKS = (
    LaneMark(points_m=((3.8, -5.0), (3.8, 14.5)), width_m=0.15, colour="#d6a83d"),
    LaneMark(points_m=((0.1, -5.0), (0.4, 14.5))),
)
LIMITS = PaintLimits(max_area_m2=1.5, contrast=(0.05, 0.25), printable=True, keep_out_m=0.3)


class PullsToBrightPaint(torch.nn.Module):
    input_size = (88, 200)

    def steer(self, frames, speed_mps, command):
        return 1e-4 * (frames[..., 100:] - frames[..., :100]).sum((1, 2, 3))

    def act(self, frame, speed_mps, command):
        raise NotImplementedError


@pytest.mark.parametrize("word", [word for word in METHODS if word != Published.word])
def test_whatever_the_search_its_patterns_obey(word, monkeypatch, tmp_path):
    monkeypatch.setattr(proposals, "PUBLISHED_ACQUISITION", {"drawn": 500, "climbs": 2})
    kind = METHODS[word]
    asked = {"iterations": 4, "restarts": 2, "halving": False} if kind is GradOpt else {"calls": 8}
    if word == "published-bo":
        asked["random_calls"] = 6
    recordings = drivable_set(12.0, marks=MARKS)
    space = SearchSpace(figures=3, family=getattr(kind, "family", "published"), limits=LIMITS)
    result = attack(
        recordings, PullsToBrightPaint(), space, objective=SteeringShift(), method=method_of(word, **asked), seed=3
    )
    site = site_of(recordings)
    assert len(result.candidates) > 1
    for candidate in result.candidates:
        told = conspicuousness(candidate.pattern, site)
        assert told.area_m2 <= 1.5
        assert told.mark_distance_m >= 0.3
        far = (candidate.pattern.colours.double() - torch.tensor(site.asphalt).double()).norm(dim=-1) / 3**0.5
        assert 0.05 <= float(far.min()) <= float(far.max()) <= 0.25
    assert result.conspicuousness == conspicuousness(result.pattern, site)
    result.save(tmp_path)
    kept = AttackResult.load(tmp_path)
    assert kept.conspicuousness == result.conspicuousness
    assert kept.space == result.space
    for candidate in kept.candidates:
        again = result.space.pattern(candidate.point_in(result.space))
        torch.testing.assert_close(again.boxes, candidate.pattern.boxes, rtol=0, atol=1e-3)
        torch.testing.assert_close(again.colours, candidate.pattern.colours)
    # In other limits, and where it is not known, it is the nearest point.
    nearest = space.unlimited.point(kept.pattern)
    assert torch.equal(kept.point_in(space.unlimited), nearest)
    assert torch.equal(replace(kept, point=None).point_in(space.unlimited), nearest)


def test_a_limited_search_by_gradient_beats_random_patterns_of_the_same_limits():
    recordings, controller = drivable_set(12.0, marks=MARKS), PullsToBrightPaint()
    space = SearchSpace(figures=3, limits=LIMITS)
    search = partial(attack, recordings, controller, space, objective=SteeringShift())
    climbed = search(method=GradOpt(iterations=20, restarts=2, halving=False))
    drawn = search(method=method_of("random", calls=60))
    assert max(climbed.by_group.values()) > max(drawn.by_group.values())


def test_the_published_search_refuses_limits_before_it_begins():
    space = SearchSpace(figures=1, limits=PaintLimits(max_area_m2=1.0))
    with pytest.raises(PatternError, match="without limits on paint"):
        attack(drivable_set(), PullsToBrightPaint(), space, method=Published())


def test_recordings_without_marks_or_canvas_are_one_line():
    keep_out = SearchSpace(figures=1, limits=PaintLimits(keep_out_m=0.2))
    with pytest.raises(PatternError, match="needs the lane marks"):
        attack(drivable_set(), PullsToBrightPaint(), keep_out)
    given = replace(keep_out, limits=PaintLimits(keep_out_m=0.2, marks=MARKS))
    once = GradOpt(iterations=1, restarts=1, halving=False)
    attack(drivable_set(), PullsToBrightPaint(), given, objective=SteeringShift(), method=once)
    area = SearchSpace(figures=1, limits=PaintLimits(max_area_m2=2.0))
    with pytest.raises(PatternError, match="size of the canvas"):
        attack(recording_set(frames=3), PullsToBrightPaint(), area)


def test_the_asphalt_is_the_paint_that_looks_like_the_bare_road():
    paint = np.array([0.42, 0.37, 0.31])
    matrix, offset = np.diag([0.6, 0.7, 0.5]) + 0.05, np.array([0.1, 0.05, 0.08])
    seen = np.round(255 * (matrix @ paint + offset)).astype(np.uint8)
    bare = drivable_set(colour=ColourTransform(AffineResponse(torch.tensor(matrix), torch.tensor(offset))))
    drives = tuple(replace(each, frames=np.broadcast_to(seen, each.frames.shape).copy()) for each in bare.recordings)
    assert site_of(replace(bare, recordings=drives)).asphalt == pytest.approx(paint, abs=0.01)
    assert site_of(drivable_set(colour=PLAIN)).size_m == (CANVAS.width_m, CANVAS.length_m)
    # It is measured where most of the canvas is seen, whatever other frames show.
    sizes = [
        0 if flat is None else len(flat) for k in range(len(drives[0].frames)) for flat in [_flat(bare, drives[0], k)]
    ]
    other = np.arange(len(sizes)) != int(np.argmax(sizes))
    dark = [np.where(other[:, None, None, None], each.frames // 3, each.frames) for each in drives]
    shaded = tuple(replace(each, frames=frames) for each, frames in zip(drives, dark, strict=True))
    assert site_of(replace(bare, recordings=shaded)).asphalt == pytest.approx(paint, abs=0.01)


def test_a_deviation_search_obeys_too(monkeypatch):
    from recorded_drives import VEHICLE
    from roadproof.recorded.vehicle import Vehicle

    monkeypatch.setattr(Vehicle, "identified", staticmethod(lambda tracks: VEHICLE))
    method = GradOpt(iterations=2, restarts=1, halving=False)
    space = SearchSpace(figures=2, limits=LIMITS)
    recordings, objective = drivable_set(12.0, marks=MARKS), PathDeviation(every=8)
    search = partial(attack, recordings, PullsToBrightPaint(), space, method=method, objective=objective)
    result = search(groups=[RIGHT_GROUP])
    assert result.conspicuousness is not None
    assert result.conspicuousness.area_m2 <= 1.5
    assert result.conspicuousness.mark_distance_m >= 0.3
    # What goes on from it begins at the pattern itself.
    gone_on = search(groups=[RIGHT_GROUP], starts=result.candidates)
    assert gone_on.history[0].max() == pytest.approx(result.by_group[result.group], abs=1e-5)
    least_m = result.predicted_range_m[0]
    monkeypatch.setattr(sys.modules[cheapest.__module__], "MOST_LEVELS", 0)
    less = cheapest(recordings, PullsToBrightPaint(), result, 0.9 * least_m, groups=[RIGHT_GROUP], objective=objective)
    assert [level.predicted_m for level in less.levels] == [pytest.approx(least_m, abs=1e-4)]

"""The fewest square metres of paint for a deviation."""

from __future__ import annotations

import json
import math
import sys
from dataclasses import replace

import pytest
import torch

from recorded_drives import VEHICLE, drivable_set
from roadproof.attacks import Cheapest, GradOpt, PathDeviation, SteeringShift, attack, cheapest, site_of
from roadproof.attacks.cheapest import Level, _Narrowing, cheapest_in_words
from roadproof.attacks.deviation import DeviationMeasure
from roadproof.attacks.gradopt import Search
from roadproof.attacks.groups import LEFT_GROUP, RIGHT_GROUP
from roadproof.compositing import Variation
from roadproof.errors import PatternError, RoadproofError
from roadproof.paint import PaintLimits, conspicuousness
from roadproof.recorded.vehicle import Vehicle
from roadproof.search_space import SearchSpace
from scenes import recording_set

GOAL = PathDeviation(every=8)


class PullsToBrightPaint(torch.nn.Module):
    input_size = (88, 200)

    def steer(self, frames, speed_mps, command):
        return 4e-5 * (frames[..., 100:] - frames[..., :100]).sum((1, 2, 3))

    def act(self, frame, speed_mps, command):
        raise NotImplementedError


@pytest.fixture(scope="module")
def searched():
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Vehicle, "identified", staticmethod(lambda tracks: VEHICLE))
        # At 12 m/s drives have half the steps; the search goes its whole way, to where no less paint will do.
        road = drivable_set(12.0)
        method = GradOpt(iterations=6, restarts=1, halving=False)
        space = SearchSpace(figures=3, limits=PaintLimits(contrast=(0.0, 0.4)))
        found = attack(road, PullsToBrightPaint(), space, method=method, objective=GOAL, groups=[RIGHT_GROUP])
        yield road, found


@pytest.mark.slow
def test_less_paint_still_reaches_the_deviation_and_keeps_the_limits(searched, tmp_path):
    road, found = searched
    wanted_m = 0.5 * found.predicted_range_m[0]
    seen = []
    less = cheapest(
        road,
        PullsToBrightPaint(),
        found,
        wanted_m,
        groups=[RIGHT_GROUP],
        objective=GOAL,
        on_level=lambda level, area: seen.append(area),
    )
    strongest = conspicuousness(found.pattern, site_of(road))
    told = less.conspicuousness
    assert told.area_m2 < 0.8 * strongest.area_m2
    assert less.predicted_m >= wanted_m
    assert [level.predicted_m >= wanted_m for level in less.levels] == [True] * len(less.levels)
    assert seen == sorted(seen, reverse=True)
    # What is told of it is what the recorded world says of its file.
    less.save(tmp_path)
    kept = Cheapest.load(tmp_path)
    measure = GOAL.measure(road, PullsToBrightPaint(), [RIGHT_GROUP], device="cpu")
    from roadproof.patterns import Pattern
    from roadproof.recorded.world import UNSURE

    batch = Pattern(kept.pattern.shapes, kept.pattern.boxes[None], kept.pattern.colours[None])
    again = measure.worlds[0].predict(PullsToBrightPaint(), batch, UNSURE).deviation_m.min()
    assert again == pytest.approx(less.predicted_m, abs=1e-3)
    assert kept.levels == less.levels
    site = site_of(road)
    far = (kept.pattern.colours.double() - torch.tensor(site.asphalt).double()).norm(dim=-1) / math.sqrt(3)
    assert float(far.max()) <= 0.4
    assert "Least paint that is predicted" in cheapest_in_words(less, wanted_m)


@pytest.mark.slow
def test_where_going_on_leads_nowhere_it_searches_afresh_and_goes_on_when_interrupted(searched, tmp_path, monkeypatch):
    road, found = searched
    wanted_m = 0.2 * found.predicted_range_m[0]
    module = sys.modules["roadproof.attacks.cheapest"]
    monkeypatch.setattr(module, "MOST_LEVELS", 2)
    monkeypatch.setattr(module, "AFRESH", GradOpt(iterations=6, restarts=2, halving=False))
    below, ways = _Narrowing.below, []

    def in_a_dead_end(self, most_m2, kept):
        on, afresh = below(self, most_m2, kept)
        unseen = replace(on.space.limits, colours=("#6a6f6f",))  # that of the asphalt
        for way in (replace(on, space=replace(on.space, limits=unseen)), afresh):
            ways.append(way.level())
            yield way

    monkeypatch.setattr(_Narrowing, "below", in_a_dead_end)
    asked = {"groups": [RIGHT_GROUP], "objective": GOAL, "folder": tmp_path}

    def interrupt(number, _area_m2):
        if number == 1:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        cheapest(road, PullsToBrightPaint(), found, wanted_m, **asked, on_level=interrupt)

    def written():
        return {path.name: path.stat().st_mtime_ns for path in (tmp_path / "search").iterdir()}

    kept = written()
    assert sorted(kept) == ["1-afresh.safetensors", "1.safetensors"]
    seen = []
    less = cheapest(road, PullsToBrightPaint(), found, wanted_m, **asked, on_level=lambda *_: seen.append(written()))
    assert kept.items() <= seen[-1].items(), "a search was done twice"
    less.save(tmp_path)
    assert not (tmp_path / "search").exists()
    dead, afresh = ways[:2]
    assert dead.predicted_m < wanted_m <= afresh.predicted_m
    at = less.levels.index(afresh)
    assert afresh.area_m2 <= 0.7 * less.levels[at - 1].area_m2 + 1e-3


def test_a_search_afresh_may_go_to_the_other_side(searched, monkeypatch):
    road, found = searched
    site = site_of(road)
    space = replace(found.space, limits=replace(found.space.limits, max_area_m2=1e4), site=None).on(site)
    strong, weak = found.point_in(space), torch.full((3, len(space.names)), 0.5)
    of_sides = Search(torch.stack([weak[None], strong[None]]), torch.zeros(2, 1), torch.zeros(1, 2, 1))
    monkeypatch.setattr(GradOpt, "search", lambda *_, **_how: of_sides)
    measure = GOAL.measure(road, PullsToBrightPaint(), [LEFT_GROUP, RIGHT_GROUP], device="cpu")
    run = _Narrowing(measure, GOAL, 0, space, 0.1, 0, 3, weak[None, None])
    _, afresh = run.below(1e4, None)
    assert (run.group, afresh.group) == (0, 1)
    torch.testing.assert_close(afresh.unit[0, 0], strong)


@pytest.mark.parametrize("family", ["published", "published-bo", "free"])
def test_the_figures_that_stay_are_the_same_without_the_one_that_goes(monkeypatch, family):
    space = SearchSpace(figures=2, family=family)
    unit = space.random((1, 1), torch.Generator().manual_seed(0))
    measure = DeviationMeasure.__new__(DeviationMeasure)
    both = _Narrowing(measure=measure, goal=GOAL, group=0, space=space, wanted_m=0.1, seed=0, figures=2, unit=unit)
    for kept in (0, 1):
        worth = torch.tensor([0.5, 0.5]).index_fill(0, torch.tensor([1 - kept]), 1.0)
        monkeypatch.setattr(_Narrowing, "_least_m", lambda _self, _space, _unit, worth=worth: worth)
        alone = both.without_a_figure()
        torch.testing.assert_close(alone.pattern.boxes, both.pattern.boxes[[kept]], atol=1e-3, rtol=0)
        torch.testing.assert_close(alone.pattern.colours, both.pattern.colours[[kept]])


def test_a_file_without_levels_or_area_is_damaged(searched, tmp_path):
    _, found = searched
    level = Level(8.0, 1, 0.06)
    told = {"group": found.group, "wanted_m": 0.05, "predicted_m": 0.06, "levels": (level,)}
    Cheapest(pattern=found.pattern, conspicuousness=found.conspicuousness, **told).save(tmp_path)
    path = tmp_path / "cheapest.json"
    content = json.loads(path.read_text())
    for broken in ({"levels": []}, {"conspicuousness": {"figures": 1}}):
        path.write_text(json.dumps(content | broken))
        with pytest.raises(RoadproofError, match=r"cheapest\.json is incomplete or damaged.*the least paint has"):
            Cheapest.load(tmp_path)


def test_the_least_paint_is_looked_for_in_expectation_where_the_strongest_was(searched, monkeypatch):
    road, found = searched
    asked, looks = [], Variation(draws=2)

    def measure(self, *_, **_how):
        asked.append(self)
        raise KeyboardInterrupt

    monkeypatch.setattr(PathDeviation, "measure", measure)
    with pytest.raises(KeyboardInterrupt):
        cheapest(road, PullsToBrightPaint(), found, 0.1, groups=[RIGHT_GROUP], objective=SteeringShift(variation=looks))
    assert asked == [PathDeviation(variation=looks)]


def test_a_deviation_that_nothing_reaches_has_no_cheapest_pattern(searched):
    road, found = searched
    assert cheapest(road, PullsToBrightPaint(), found, 90.0, groups=[RIGHT_GROUP], objective=GOAL) is None
    assert "there is none with less paint" in cheapest_in_words(None, 90.0)


def test_deviations_out_of_range_and_canvases_of_unknown_size_are_one_line(searched):
    road, found = searched
    with pytest.raises(RoadproofError, match=r"cheapest is 0\.0 m, expected metres"):
        cheapest(road, PullsToBrightPaint(), found, 0.0, groups=[RIGHT_GROUP])
    with pytest.raises(RoadproofError, match=r"found for clean\+right, the groups are clean\+left; give"):
        cheapest(road, PullsToBrightPaint(), found, 0.5, groups=[LEFT_GROUP])
    with pytest.raises((PatternError, RoadproofError), match="canvas"):
        cheapest(recording_set(frames=3), PullsToBrightPaint(), found, 0.5, groups=[RIGHT_GROUP])

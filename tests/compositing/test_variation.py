"""What varies between looks: ranges, seeds, and how each part shows."""

from __future__ import annotations

from dataclasses import fields

import numpy as np
import pytest
import torch
from scipy.ndimage import gaussian_filter

from roadproof.compositing.variation import Variation
from roadproof.coverage import Shape
from roadproof.errors import RoadproofError
from roadproof.geometry import CanvasPlacement
from roadproof.paint.site import half_edges_m
from roadproof.patterns import Pattern

ZERO = dict.fromkeys(("noise", "exposure_stops", "white_balance", "blur_px", "shift_m", "turn_deg", "wear"), 0.0)
NOTHING = Variation(**ZERO, draws=3)
CANVAS = CanvasPlacement(x_m=0.0, y_m=0.0)


def only(**ranges):
    return Variation(**{each.name: getattr(NOTHING, each.name) for each in fields(Variation)} | ranges)


def cross(one, other):
    return one[..., 0] * other[..., 1] - one[..., 1] * other[..., 0]


def angle(one, other):
    return torch.atan2(cross(one, other), (one * other).sum(-1))


def pictures(count=6):
    return 0.3 + 0.4 * torch.rand(count, 3, 20, 30, generator=torch.Generator().manual_seed(2))


def test_the_same_seed_draws_the_same_and_another_others():
    one, again, other = (Variation().draw(seed) for seed in (4, 4, 5))
    for field in fields(one):
        if isinstance(value := getattr(one, field.name), torch.Tensor):
            assert torch.equal(value, getattr(again, field.name))
            assert not torch.equal(value, getattr(other, field.name))
    frames = pictures(4)
    assert torch.equal(one.seen(frames, 4, 7), again.seen(frames, 4, 7))
    assert not torch.equal(one.seen(frames, 4, 7), one.seen(frames, 4, 8))


def test_draws_cover_every_range_evenly():
    looks = Variation(wear=0.4, shift_m=0.2, turn_deg=3.0, exposure_stops=1.0).draw(1, count=16)
    assert torch.equal((looks.wear / 0.4 * 16).floor().sort().values, torch.arange(16.0))
    assert torch.equal(((looks.shift_m + 0.2) / 0.4 * 16).floor().sort(0).values[:, 0], torch.arange(16.0))
    assert float(looks.turn_deg.abs().max()) <= 3.0
    stops = 2.2 * looks.gain[:, 1].log2()
    assert torch.equal(((stops + 1) / 2 * 16).floor().sort().values, torch.arange(16.0))


def test_nothing_varies_where_all_ranges_are_zero():
    looks, frames = NOTHING.draw(1), pictures()
    assert torch.equal(looks.seen(frames, 3), frames)
    assert torch.equal(looks.left(torch.rand(1, 50, 2) * 400, 3), torch.ones(3, 50))
    boxes = torch.tensor([[[100.0, 120.0, 20.0, 60.0, 30.0]]]).repeat(3, 1, 1)
    pattern = Pattern((Shape.RECTANGLE,), boxes, torch.zeros(3, 1, 3))
    torch.testing.assert_close(looks.placed(pattern, CANVAS).boxes, boxes)


def test_exposure_and_white_balance_are_gains_of_their_channels():
    looks = only(exposure_stops=0.5, white_balance=0.1).draw(3)
    frames = pictures(3) * 0.5
    torch.testing.assert_close(looks.seen(frames, 3), frames * looks.gain[:, :, None, None])
    red, green, blue = looks.gain.unbind(1)
    torch.testing.assert_close(red + blue, 2 * green)
    assert float(green.log2().abs().max()) <= 0.5 / 2.2


def test_blur_has_the_variance_of_a_gaussian():
    looks = only(blur_px=0.7).draw(1, count=2)
    point = torch.zeros(2, 3, 21, 21)
    point[:, :, 10, 10] = 1.0
    seen = looks.seen(point, 2)
    x = torch.arange(21.0) - 10
    for k in range(2):
        spread = (seen[k, 0].sum(0) * x.square()).sum()
        torch.testing.assert_close(spread, looks.blur[k] / 2)
        sigma = float((looks.blur[k] / 2).sqrt())
        frame = pictures(1)[0, 0].numpy()
        known = gaussian_filter(frame, sigma, mode="nearest", truncate=6) if sigma > 0.4 else None
        ours = looks.seen(pictures(1).repeat(2, 1, 1, 1), 2)[k, 0].numpy()
        if known is not None:
            assert np.abs(ours - known).mean() < 0.5 * np.abs(frame - known).mean()


def test_noise_has_its_deviation_and_is_the_same_for_rows_of_one_look():
    looks, grey = only(noise=0.05).draw(1), torch.full((6, 3, 88, 200), 0.5)
    seen = looks.seen(grey, 6, 3)
    assert float(seen.std()) == pytest.approx(0.05, rel=0.02)
    assert torch.equal(seen[0], seen[3])
    assert not torch.equal(seen[0], seen[1])
    drives = looks.seen(torch.full((12, 3, 88, 200), 0.5), 6).unflatten(0, (6, 2))
    assert torch.equal(drives[0], drives[3])
    assert not torch.equal(drives[0, 0], drives[0, 1]), "every picture of a drive has noise of its own"


@pytest.mark.parametrize("wear", [0.1, 0.5, 0.8])
def test_as_much_paint_is_gone_as_was_drawn(wear):
    looks = only(wear=wear).draw(1, count=64)
    x, y = torch.meshgrid(torch.arange(0, 400, 8.0), torch.arange(0, 400, 8.0), indexing="ij")
    left = looks.left(torch.stack([x, y], -1).reshape(1, -1, 2), 64)
    gone = 1 - left.mean(1)
    assert float((gone - looks.wear).abs().mean()) < 0.05
    patchy = left[looks.wear > 0.6 * wear]
    assert float(((patchy < 0.1) | (patchy > 0.9)).float().mean()) > 0.7, "patches, not a veil"


def test_paint_moves_as_one_piece():
    looks = only(shift_m=0.3, turn_deg=10.0).draw(6)
    boxes = torch.tensor([[[100.0, 120.0, 20.0, 60.0, 30.0], [300.0, 50.0, 10.0, 90.0, 0.0]]]).repeat(3, 1, 1)
    boxes[:, 1, 4] = torch.tensor([0.0, 90.0, 250.0])
    placed = looks.placed(Pattern((Shape.RECTANGLE,) * 2, boxes, torch.zeros(3, 2, 3)), CANVAS).boxes
    scale = torch.tensor([CANVAS.width_m, CANVAS.length_m]) / 400
    way = (boxes[:, 0, :2] - boxes[:, 1, :2]) * scale
    moved = (placed[:, 0, :2] - placed[:, 1, :2]) * scale
    torch.testing.assert_close(moved.norm(dim=1), way.norm(dim=1))
    turned = torch.rad2deg(torch.atan2(moved[:, 1], moved[:, 0]) - torch.atan2(way[:, 1], way[:, 0]))
    torch.testing.assert_close(turned, looks.turn_deg, atol=1e-3, rtol=1e-4)
    # So does the length of every figure, and its area stays, though pixels are not square.
    (_, across, along), (_, across_now, along_now) = (
        half_edges_m(each, (CANVAS.width_m, CANVAS.length_m)) for each in (boxes, placed)
    )
    torch.testing.assert_close(along_now.norm(dim=-1), along.norm(dim=-1))
    torch.testing.assert_close(torch.rad2deg(angle(along, along_now)), looks.turn_deg[:, None].expand(3, 2))
    torch.testing.assert_close(cross(across_now, along_now), cross(across, along))


@pytest.mark.parametrize("ranges", [{"wear": 0.95}, {"draws": 0}, {"blur_px": -0.1}, {"noise": 0.5}])
def test_ranges_that_make_no_sense_are_one_line(ranges):
    with pytest.raises(RoadproofError, match=f"variation: {next(iter(ranges))} is"):
        Variation(**ranges)

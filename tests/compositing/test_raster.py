"""Pictures of the canvas painted into frames, against the figures that they show."""

import dataclasses

import numpy as np
import pytest
import torch

from recorded_drives import drivable_set, shown_from
from roadproof.compositing.composite import composite_own
from roadproof.compositing.raster import composite_raster
from roadproof.patterns import Pattern, raster
from roadproof.recorded.pictures import FrameBank
from roadproof.search_space import SearchSpace

MAGENTA = np.full((400, 400, 4), (255, 0, 255, 255), np.uint8)


@pytest.fixture(scope="module")
def recordings():
    return drivable_set()


@pytest.mark.parametrize(("figures", "tolerance"), [(1, 0.6), (5, 1.5)])
def test_a_raster_is_seen_as_its_figures_are(recordings, figures, tolerance):
    """Within a level or so of the exact compositing, on average over the paint.

    Where several figures share a far pixel, the exact one takes their edges for independent; a raster need not.
    """
    bank, track = FrameBank(recordings), recordings.recordings[0].track
    space = SearchSpace(figures=figures)
    patterns = space.drawn(4, 1)
    errors, sums = [], []
    for row in range(40, 115, 15):
        views = bank.show(*shown_from(bank, track, row))
        for k in range(4):
            one = patterns[k]
            exact = composite_own(Pattern(one.shapes, one.boxes[None], one.colours[None]), views.frames, views.canvas)
            sampled = composite_raster(raster(one), views.frames, views.canvas)
            paint = (exact - views.frames).abs().sum(1) > 1e-4
            errors.append(255 * (sampled - exact).abs().mean(1)[paint])
            sums.append(255 * (sampled - exact).mean(1)[paint])
    assert float(torch.cat(errors).mean()) < tolerance
    assert abs(float(torch.cat(sums).mean())) < 0.2, "and neither lighter nor darker"


def test_alpha_and_the_response_of_the_colours_count(recordings):
    """A half transparent paint is half way between the road and the same paint opaque, whatever paint is seen as."""
    bank = FrameBank(recordings)
    views = bank.show(*shown_from(bank, recordings.recordings[0].track, 60))
    views = views._replace(canvas=dataclasses.replace(views.canvas, response=lambda p: 0.2 + 0.5 * p))
    half = MAGENTA.copy()
    half[..., 3] = 127
    opaque, thin = (composite_raster(paint, views.frames, views.canvas) for paint in (MAGENTA, half))
    torch.testing.assert_close(thin, torch.lerp(views.frames, opaque, 127 / 255), atol=1e-5, rtol=0)
    inside = views.canvas.pixel[views.canvas.gain[..., 0] > 0.999]
    torch.testing.assert_close(opaque.flatten(2)[0, :, inside[0]], torch.tensor([0.7, 0.2, 0.7]), atol=1e-5, rtol=0)

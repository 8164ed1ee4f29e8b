"""Painting in one pass: values and gradients of plain operations; by Triton's interpreter where there is no GPU."""

import numpy as np
import pytest
import torch

from kernels import DEVICE  # isort: skip  # before Triton is imported
from roadproof.compositing import fused, view
from roadproof.compositing.composite import blend
from roadproof.compositing.view import CanvasPixels
from roadproof.coverage import Footprints
from roadproof.patterns import coverages, visibilities
from roadproof.photometry import AffineResponse
from roadproof.search_space import SearchSpace


def some_pixels(many, own=None, seed=0):
    """Pixels all over the canvas, near and far; `own` patterns have some of their own each."""
    rng = np.random.default_rng(seed)
    rows = () if own is None else (own,)
    centre = rng.uniform(-5, 405, (*rows, many, 2))
    jacobian = rng.normal(size=(*rows, many, 2, 2)) * rng.uniform(0.5, 20, (*rows, many, 1, 1))
    made = Footprints.made(torch.tensor(centre).float(), torch.tensor(jacobian).float(), "area")
    parts = (part if own is None else part[:, None] for part in (made.centre, made.jacobian, made.features))
    clean, gain, bias = (torch.tensor(rng.uniform(low, 1, (*rows, many, 3))).float() for low in (0, 0.3, -0.8))
    response = AffineResponse(torch.eye(3) * 1.2, torch.full((3,), -0.1))
    return CanvasPixels(
        footprints=Footprints(*(part.to(DEVICE) for part in parts), made.variance),
        clean=clean.to(DEVICE),
        gain=gain.to(DEVICE),
        bias=bias.to(DEVICE),
        response=response,
        runs=None,
    )


def both(pixels, unit, space):
    """Colours and gradients in the points, in one pass and by plain operations."""
    found = []
    for paint in (
        fused.painted,
        lambda pattern, here: blend(
            visibilities(coverages(pattern, here.footprints)), here.response(pattern.colours), here
        ),
    ):
        leaf = unit.clone().requires_grad_()
        colours = paint(space.pattern(leaf), pixels)
        weight = torch.randn(colours.shape, generator=torch.Generator().manual_seed(1)).to(DEVICE)
        found.append((colours.detach(), torch.autograd.grad((colours * weight).sum(), leaf)[0]))
    return found


@pytest.mark.parametrize("figures", [1, 5])
@pytest.mark.parametrize("family", ["published", "free"])
def test_one_pass_paints_as_plain_operations_do(figures, family):
    space = SearchSpace(figures=figures, family=family)
    unit = space.random((2,), torch.Generator().manual_seed(figures)).to(DEVICE)
    (colours, gradient), (plain, expected) = both(some_pixels(300), unit, space)
    torch.testing.assert_close(colours, plain, rtol=0, atol=3e-5)
    assert (colours == 0).any()
    assert (colours == 1).any()
    torch.testing.assert_close(gradient, expected, rtol=1e-3, atol=1e-3)


def test_each_pattern_may_have_pixels_of_its_own():
    space = SearchSpace(figures=3)
    unit = space.random((3,), torch.Generator().manual_seed(0)).to(DEVICE)
    (colours, gradient), (plain, expected) = both(some_pixels(70, own=3), unit, space)
    torch.testing.assert_close(colours, plain, rtol=0, atol=3e-5)
    torch.testing.assert_close(gradient, expected, rtol=1e-3, atol=1e-3)


def test_a_single_pattern_needs_no_batch_and_comes_out_the_same_twice():
    space, pixels = SearchSpace(figures=2), some_pixels(40)
    unit = space.random((1,), torch.Generator().manual_seed(3)).to(DEVICE)
    (many, _), _ = both(pixels, unit, space)
    (one, gradient), _ = both(pixels, unit[0], space)
    assert torch.equal(one, many[0])
    (again, same), _ = both(pixels, unit[0], space)
    assert torch.equal(one, again)
    assert torch.equal(gradient, same)


def test_nan_is_painted_as_nan():
    space, pixels = SearchSpace(figures=2), some_pixels(20)
    unit = space.random((1,), torch.Generator().manual_seed(3)).to(DEVICE)
    for number in (0, 6):
        unit[0, 1, number] = torch.nan
        assert fused.painted(space.pattern(unit), pixels).isnan().all()


GPU = torch.device("cuda", 0)


def test_without_triton_painting_goes_on_as_before(monkeypatch):
    def refuses(device):
        raise RuntimeError("Failed to find C compiler")

    monkeypatch.setattr(fused, "try_out", refuses)
    view.compiles_kernels.cache_clear()
    assert not view.compiles_kernels(GPU)
    view.compiles_kernels.cache_clear()


@pytest.mark.parametrize("without", [torch.no_grad, torch.inference_mode])
def test_whoever_asks_first_may_do_so_without_gradients(monkeypatch, without):
    tried = fused.try_out
    monkeypatch.setattr(fused, "try_out", lambda _: tried(torch.device(DEVICE)))
    view.compiles_kernels.cache_clear()
    with without():
        assert view.compiles_kernels(GPU)
    view.compiles_kernels.cache_clear()

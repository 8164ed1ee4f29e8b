"""Painting in one pass: values and gradients of plain operations; by Triton's interpreter where there is no GPU."""

import pytest
import torch

from kernels import DEVICE  # isort: skip  # before Triton is imported
from pixels import both, some_pixels
from roadproof.compositing import fused, view
from roadproof.search_space import SearchSpace


@pytest.mark.parametrize("figures", [1, 5])
@pytest.mark.parametrize("family", ["published", "free"])
def test_one_pass_paints_as_plain_operations_do(figures, family):
    space = SearchSpace(figures=figures, family=family)
    unit = space.random((2,), torch.Generator().manual_seed(figures)).to(DEVICE)
    (colours, gradient), (plain, expected) = both(fused.painted, some_pixels(300, device=DEVICE), unit, space)
    torch.testing.assert_close(colours, plain, rtol=0, atol=3e-5)
    assert (colours == 0).any()
    assert (colours == 1).any()
    torch.testing.assert_close(gradient, expected, rtol=1e-3, atol=1e-3)


def test_each_pattern_may_have_pixels_of_its_own():
    space = SearchSpace(figures=3)
    unit = space.random((3,), torch.Generator().manual_seed(0)).to(DEVICE)
    (colours, gradient), (plain, expected) = both(fused.painted, some_pixels(70, own=3, device=DEVICE), unit, space)
    torch.testing.assert_close(colours, plain, rtol=0, atol=3e-5)
    torch.testing.assert_close(gradient, expected, rtol=1e-3, atol=1e-3)


def test_a_single_pattern_needs_no_batch_and_comes_out_the_same_twice():
    space, pixels = SearchSpace(figures=2), some_pixels(40, device=DEVICE)
    unit = space.random((1,), torch.Generator().manual_seed(3)).to(DEVICE)
    (many, _), _ = both(fused.painted, pixels, unit, space)
    (one, gradient), _ = both(fused.painted, pixels, unit[0], space)
    assert torch.equal(one, many[0])
    (again, same), _ = both(fused.painted, pixels, unit[0], space)
    assert torch.equal(one, again)
    assert torch.equal(gradient, same)


def test_nan_is_painted_as_nan():
    space, pixels = SearchSpace(figures=2), some_pixels(20, device=DEVICE)
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

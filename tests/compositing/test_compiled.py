"""Painting in one pass on a CPU: values and gradients of plain operations, whoever computes them."""

import pytest
import torch

from pixels import both, some_pixels
from roadproof.compositing import compiled
from roadproof.search_space import SearchSpace


@pytest.mark.parametrize("figures", [1, 5])
@pytest.mark.parametrize("family", ["published", "free"])
def test_one_pass_paints_as_plain_operations_do(figures, family):
    space = SearchSpace(figures=figures, family=family)
    unit = space.random((2,), torch.Generator().manual_seed(figures))
    (colours, gradient), (plain, expected) = both(compiled.painted, some_pixels(3000), unit, space)
    torch.testing.assert_close(colours, plain, rtol=0, atol=3e-5)
    assert (colours == 0).any()
    assert (colours == 1).any()
    torch.testing.assert_close(gradient, expected, rtol=1e-3, atol=2e-3)


def test_each_pattern_may_have_pixels_of_its_own():
    space = SearchSpace(figures=3)
    unit = space.random((3,), torch.Generator().manual_seed(0))
    (colours, gradient), (plain, expected) = both(compiled.painted, some_pixels(700, own=3), unit, space)
    torch.testing.assert_close(colours, plain, rtol=0, atol=3e-5)
    torch.testing.assert_close(gradient, expected, rtol=1e-3, atol=1e-3)


def test_any_number_of_threads_adds_up_to_the_same(two_threads):
    space, pixels = SearchSpace(figures=4), some_pixels(3 * compiled.BLOCK + 5)
    unit = space.random((2,), torch.Generator().manual_seed(2))
    (colours, gradient), _ = both(compiled.painted, pixels, unit, space)
    torch.set_num_threads(1)
    (alone, same), (plain, expected) = both(compiled.painted, pixels, unit, space)
    assert torch.equal(colours, alone)
    assert torch.equal(gradient, same)
    torch.testing.assert_close(colours, plain, rtol=0, atol=3e-5)
    torch.testing.assert_close(gradient, expected, rtol=1e-3, atol=1e-2)


def test_a_single_pattern_needs_no_batch():
    space, pixels = SearchSpace(figures=2), some_pixels(400)
    unit = space.random((1,), torch.Generator().manual_seed(3))
    (many, _), _ = both(compiled.painted, pixels, unit, space)
    (one, _), _ = both(compiled.painted, pixels, unit[0], space)
    assert torch.equal(one, many[0])


def test_nan_is_painted_as_nan():
    space, pixels = SearchSpace(figures=2), some_pixels(20)
    for number in (0, 6):
        unit = space.random((2,), torch.Generator().manual_seed(3))
        unit[0, 1, number] = torch.nan
        painted = compiled.painted(space.pattern(unit), pixels)
        assert painted[0].isnan().all()
        assert painted[1].isfinite().all()

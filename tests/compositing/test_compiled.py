"""Painting in one pass on a CPU: values and gradients of plain operations, whoever computes them."""

import pytest
import torch

from pixels import both, some_pixels
from roadproof.compositing import compiled
from roadproof.compositing.compiled import Place
from roadproof.coverage import Shape
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


@pytest.mark.parametrize("shape", [each for each in Shape if each is not Shape.RECTANGLE])
def test_other_shapes_are_painted_as_plain_operations_do(shape):
    space = SearchSpace(figures=4, family="free", shape=shape)
    unit = space.random((3,), torch.Generator().manual_seed(1))
    for pixels in (some_pixels(3000), some_pixels(1000, own=3)):
        (colours, gradient), (plain, expected) = both(compiled.painted, pixels, unit, space)
        # Plain operations lose digits in a polygon where a footprint is nearly a line.
        torch.testing.assert_close(colours, plain, rtol=0, atol=2e-4)
        assert (colours != pixels.clean).any()
        torch.testing.assert_close(gradient, expected, rtol=1e-3, atol=2e-3)


def test_each_pattern_may_have_pixels_of_its_own():
    space = SearchSpace(figures=3)
    unit = space.random((3,), torch.Generator().manual_seed(0))
    (colours, gradient), (plain, expected) = both(compiled.painted, some_pixels(700, own=3), unit, space)
    torch.testing.assert_close(colours, plain, rtol=0, atol=3e-5)
    torch.testing.assert_close(gradient, expected, rtol=1e-3, atol=1e-3)


@pytest.mark.parametrize("channels", ["first", "last"])
def test_pictures_are_painted_in_any_order_of_their_numbers_and_only_where_pixels_count(channels):
    space, views = SearchSpace(figures=2), [some_pixels(90), some_pixels(60, own=2, seed=1)]
    pictures = torch.rand(6, 3, 50, generator=torch.Generator().manual_seed(0))
    pictures = pictures if channels == "first" else pictures.mT.contiguous().mT
    bare = pictures.clone()
    shuffled = torch.randperm(100, generator=torch.Generator().manual_seed(1))[:90]
    own = torch.stack([torch.randperm(50, generator=torch.Generator().manual_seed(k)) for k in (2, 3)])
    own = torch.cat([own, own[:, -1:].expand(-1, 10)], 1)
    # Two patterns with two pictures each, then two with a picture and pixels of its own each, some of them copies.
    places = [Place(shuffled[None], torch.tensor([90]), 0, 2), Place(own, torch.tensor([50, 20]), 4, 1)]
    units = [space.random((2,), torch.Generator().manual_seed(k)).requires_grad_() for k in (4, 5)]
    found = compiled.painted_into(pictures, [space.pattern(unit) for unit in units], views, places)
    assert found.data_ptr() == pictures.data_ptr()
    alone = [compiled.painted(space.pattern(unit), view) for unit, view in zip(units, views, strict=True)]
    expected = bare.clone()
    expected[:4] = expected[:4].view(2, 2, 3, 50).transpose(1, 2).flatten(2).index_copy(
        2, shuffled, alone[0].detach().mT).view(2, 3, 2, 50).transpose(1, 2).flatten(0, 1)  # fmt: skip
    for b, count in enumerate((50, 20)):
        expected[4 + b].index_copy_(1, own[b, :count], alone[1][b, :count].detach().mT)
    assert torch.equal(found, expected)
    weight = torch.randn(found.shape, generator=torch.Generator().manual_seed(6))
    weight = weight if channels == "first" else weight.mT.contiguous().mT
    got = torch.autograd.grad((found * weight).sum(), units)
    flat = weight[:4].view(2, 2, 3, 50).transpose(1, 2).flatten(2)[..., shuffled].mT
    value = (alone[0] * flat).sum()
    for b, count in enumerate((50, 20)):
        value = value + (alone[1][b, :count] * weight[4 + b][:, own[b, :count]].mT).sum()
    for one, other in zip(got, torch.autograd.grad(value, units), strict=True):
        torch.testing.assert_close(one, other)


def test_a_gradient_that_is_the_same_everywhere_needs_no_numbers_of_its_own():
    space, pixels = SearchSpace(figures=2), some_pixels(40)
    unit = space.random((2,), torch.Generator().manual_seed(0)).requires_grad_()
    (one,) = torch.autograd.grad(compiled.painted(space.pattern(unit), pixels).sum(), unit)
    (other,) = torch.autograd.grad((compiled.painted(space.pattern(unit), pixels) * torch.ones(2, 40, 3)).sum(), unit)
    assert torch.equal(one, other)


def test_what_was_painted_over_gives_no_gradient_any_more():
    space, pixels = SearchSpace(figures=2), some_pixels(40)
    unit = space.random((1,), torch.Generator().manual_seed(0)).requires_grad_()
    pictures, place = torch.zeros(1, 3, 40), Place(torch.arange(40)[None], torch.tensor([40]))
    first = compiled.painted_into(pictures, [space.pattern(unit)], [pixels], [place]).square()
    compiled.painted_into(pictures, [space.pattern(unit)], [pixels], [place])
    with pytest.raises(RuntimeError, match="modified by an inplace operation"):
        first.sum().backward()


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


@pytest.mark.parametrize("shape", [Shape.ELLIPSE, Shape.DIAMOND])
def test_other_shapes_add_up_to_the_same_by_any_number_of_threads(two_threads, shape):
    space, pixels = SearchSpace(figures=4, family="free", shape=shape), some_pixels(3 * compiled.BLOCK + 5)
    unit = space.random((2,), torch.Generator().manual_seed(2))
    (colours, gradient), (plain, expected) = both(compiled.painted, pixels, unit, space)
    torch.set_num_threads(1)
    (alone, same), _ = both(compiled.painted, pixels, unit, space)
    assert torch.equal(colours, alone)
    assert torch.equal(gradient, same)
    # Plain operations lose digits in a polygon where a footprint is nearly a line.
    assert ((colours - plain).abs() > 3e-5).float().mean() <= 1e-3
    torch.testing.assert_close(gradient, expected, rtol=1e-2, atol=1e-2)


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

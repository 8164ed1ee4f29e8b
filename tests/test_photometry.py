"""Colour against closed forms, a plain numpy reference, synthetic roads and the real CARLA renders."""

import csv
import itertools
import json
from pathlib import Path

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from PIL import Image

from roadproof.errors import ColourError
from roadproof.photometry import (
    AffineResponse,
    ColourSamples,
    ColourTransform,
    FilmResponse,
    RadialShading,
    fit_affine,
    fit_colour,
    pixel_maps_from_two_paints,
    samples_from_pictures,
)
from roadproof.photometry.fitting import _ColourProblem
from roadproof.photometry.responses import decode_srgb, encode_srgb

F64 = torch.float64
FILM = FilmResponse(
    torch.tensor([0.19, 0.21, 0.25], dtype=F64), torch.tensor(1.8, dtype=F64), torch.tensor(0.9, dtype=F64)
)
AFFINE = AffineResponse(
    torch.tensor([[0.75, -0.07, -0.08], [-0.02, 0.7, -0.02], [0.01, 0.03, 0.7]], dtype=F64),
    torch.tensor([-0.1, -0.09, -0.1], dtype=F64),
)
SHADING = RadialShading(width_px=80, height_px=60, gain=-0.13, offset=-0.03)
LEVELS = torch.tensor([0.2, 0.45, 0.8], dtype=F64)
COLOURS = torch.cartesian_prod(LEVELS, LEVELS, LEVELS)
unit = st.floats(0.0, 1.0)


def film_reference(painted: np.ndarray) -> np.ndarray:
    """The formula of `FilmResponse`, colour by colour, with matrices from the primaries' chromaticities."""

    def xyz_from_rgb(xy: list[tuple[float, float]], white: tuple[float, float]) -> np.ndarray:
        columns = np.array([[x / y, 1, (1 - x - y) / y] for x, y in xy]).T
        target = np.array([white[0] / white[1], 1, (1 - white[0] - white[1]) / white[1]])
        return columns * np.linalg.solve(columns, target)

    srgb = xyz_from_rgb([(0.64, 0.33), (0.3, 0.6), (0.15, 0.06)], (0.3127, 0.329))
    wide = xyz_from_rgb([(0.713, 0.293), (0.165, 0.83), (0.128, 0.044)], (0.32168, 0.33767))
    cone = np.array([[0.8951, 0.2664, -0.1614], [-0.7502, 1.7135, 0.0367], [0.0389, -0.0685, 1.0296]])
    adapt = np.linalg.inv(cone) @ np.diag((cone @ wide.sum(1)) / (cone @ srgb.sum(1))) @ cone
    wide_from_srgb = np.linalg.inv(wide) @ adapt @ srgb
    luminance = wide[1]
    seen = []
    for colour in painted:
        light = np.where(colour <= 0.04045, colour / 12.92, ((colour + 0.055) / 1.055) ** 2.4) * FILM.exposure.numpy()
        t = wide_from_srgb @ light
        t = 0.96 * t + 0.04 * (luminance @ t)
        t = t**1.8 / (1 + t**1.8)
        t = 0.93 * t + 0.07 * (luminance @ t)
        y = np.maximum(np.linalg.inv(wide_from_srgb) @ t, 0)
        for power in (0.9, 1.0):
            y = np.where(y <= 0.0031308, 12.92 * y, 1.055 * y ** (1 / 2.4) - 0.055) ** power
        seen.append(y)
    return np.array(seen)


def test_film_response_is_its_formula():
    seen = FILM(COLOURS).clamp(0, 1).numpy()
    np.testing.assert_allclose(seen, film_reference(COLOURS.numpy()), atol=2e-3)


@given(st.floats(0.0, 1.0))
@settings(derandomize=True, deadline=None)
def test_srgb_encoding_and_decoding_undo_each_other(value):
    encoded = torch.tensor([value], dtype=F64)
    assert encode_srgb(decode_srgb(encoded)).item() == pytest.approx(value, abs=1e-7)


def test_srgb_decoding_gives_the_published_value_of_middle_grey():
    assert decode_srgb(torch.tensor([0.5], dtype=F64)).item() == pytest.approx(0.21404114)


@given(unit, unit)
@settings(derandomize=True, deadline=None)
def test_a_brighter_grey_is_seen_brighter_and_stays_grey_under_grey_light(first, second):
    film = FilmResponse(torch.full((3,), 0.5, dtype=F64), FILM.contrast, FILM.encoding)
    dark, bright = film(torch.tensor([[v] * 3 for v in sorted((first, second))], dtype=F64))
    assert (bright >= dark).all()
    assert (bright.max() - bright.min()).item() < 1e-6


@pytest.mark.parametrize("response", [FILM, AFFINE])
def test_gradients_of_responses_are_exact(response):
    painted = COLOURS.clone().requires_grad_()
    assert torch.autograd.gradcheck(response, (painted,))


def test_a_film_response_never_loses_its_gradient_at_the_ends_of_the_scale():
    painted = torch.tensor(list(itertools.product([0.0, 1.0], repeat=3)), requires_grad=True)
    (gradient,) = torch.autograd.grad(FILM(painted).sum(), painted)
    assert gradient.isfinite().all()
    assert (gradient != 0).all()


@pytest.mark.parametrize("response", [FILM, AFFINE])
def test_single_precision_gives_the_same_colours(response):
    single = response(COLOURS.float())
    assert single.dtype == torch.float32
    assert (single - response(COLOURS)).abs().max() < 0.1 / 255


def test_an_affine_fit_recovers_the_map_although_channels_are_clipped():
    seen = AFFINE(COLOURS).clamp(0, 1)
    assert (seen == 0).any()
    fitted = fit_affine(COLOURS, seen)
    torch.testing.assert_close(fitted.matrix, AFFINE.matrix)
    torch.testing.assert_close(fitted.offset, AFFINE.offset)
    biased = fit_affine(COLOURS, seen, keep_saturated=True)
    assert (biased.matrix - AFFINE.matrix).abs().max() > 0.01


def looks(response, shading=None, noise: float = 0.0) -> ColourSamples:
    """Every colour seen at nine places of the left half of the picture."""
    places = torch.cartesian_prod(torch.tensor([2.0, 20.0, 38.0]), torch.tensor([30.0, 42.0, 57.0])).double()
    painted, pixel = COLOURS.repeat_interleave(9, 0), places.repeat(27, 1)
    exact = ColourTransform(response, shading)(painted, pixel)
    seen = (exact + noise * torch.randn(exact.shape, generator=torch.Generator().manual_seed(1), dtype=F64)).clamp(0, 1)
    group = (torch.arange(27) % 4).repeat_interleave(9)
    return ColourSamples(painted, seen, group=group, pixel=pixel, size_px=(80, 60))


@pytest.mark.parametrize(("response", "name"), [(FILM, "film"), (AFFINE, "affine")])
def test_cross_validation_chooses_the_model_that_made_the_colours(response, name):
    samples = looks(response, SHADING, noise=1 / 255)
    fit = fit_colour(samples)
    assert fit.report.model == f"{name} + radial shading"
    assert fit.report.left_out < 1.1
    for kind, shading in itertools.product((FilmResponse, AffineResponse), (False, True)):
        each = fit_colour(samples, response=kind, shading=shading).report
        assert each.model == fit.report.model or each.left_out > fit.report.left_out
    elsewhere = torch.tensor([[75.0, 5.0]], dtype=F64).expand(27, 2)
    truth = ColourTransform(response, SHADING)(COLOURS, elsewhere)
    assert (fit.transform(COLOURS, elsewhere) - truth).abs().mean() < 1.5 / 255


@pytest.mark.parametrize("kind", [FilmResponse, AffineResponse])
def test_the_slopes_of_the_fit_are_those_of_central_differences(kind):
    problem = _ColourProblem(looks(AFFINE, SHADING, noise=4 / 255), kind, shade=True)
    at = torch.linspace(-0.4, 0.6, 7 if kind is FilmResponse else 14, dtype=F64)
    steps = 1e-6 * torch.eye(len(at), dtype=F64)
    slopes = torch.stack([(problem.residuals(at + step) - problem.residuals(at - step)) / 2e-6 for step in steps], 1)
    torch.testing.assert_close(problem.jacobian(at), slopes, atol=1e-6, rtol=1e-5)


def test_a_fit_without_pixels_is_flat_and_repeats_exactly():
    flat = looks(FILM)
    samples = ColourSamples(flat.painted, flat.seen, group=flat.group)
    first, second = fit_colour(samples, response=FilmResponse), fit_colour(samples, response=FilmResponse)
    assert first.transform.shading is None
    assert first.transform.to_dict() == second.transform.to_dict()
    torch.testing.assert_close(first.transform.response(COLOURS), FILM(COLOURS), atol=1e-4, rtol=0)


def test_one_wild_picture_does_not_bend_the_film_response():
    samples = looks(FILM, noise=0.5 / 255)
    seen = samples.seen.clone()
    seen[:9] = torch.tensor([0.9, 0.1, 0.9])
    fit = fit_colour(ColourSamples(samples.painted, seen, group=samples.group), response=FilmResponse)
    rest = samples.painted[9:]
    assert (fit.transform.response(rest) - FILM(rest)).abs().mean() < 2.5 / 255


def test_left_out_errors_are_those_of_fits_without_the_group():
    samples = looks(AFFINE, noise=2 / 255)
    group = (samples.painted[:, 0] * 100).long()
    grouped = ColourSamples(samples.painted, samples.seen, group=group)
    report = fit_colour(grouped, response=AffineResponse).report
    errors = torch.zeros_like(samples.seen)
    for value in group.unique():
        out = group == value
        fitted = fit_affine(samples.painted[~out], samples.seen[~out])
        errors[out] = 255 * (fitted(samples.painted[out]).clamp(0, 1) - samples.seen[out]).abs()
    assert report.left_out == pytest.approx(errors.mean().item())


def test_a_fit_that_cannot_be_cross_validated_says_so():
    painted = torch.tensor([[0.4, 0.4, 0.4], [0.8, 0.5, 0.4], [0.4, 0.8, 0.4], [0.4, 0.4, 0.8]], dtype=F64)
    report = fit_colour(ColourSamples(painted, 0.5 * painted), response=AffineResponse).report
    assert report.left_out is None
    assert report.residual == pytest.approx(0, abs=1e-9)


def test_a_transform_is_separable_and_clipped():
    transform = ColourTransform(AFFINE, SHADING)
    pixel = torch.tensor([[39.5, 29.5], [79.5, 29.5], [39.5, 59.5]], dtype=F64)
    gain, offset = transform.gain_and_offset(pixel)
    torch.testing.assert_close(gain[:, 0], torch.tensor([1.0, 0.87, 1 - 0.13 * 0.5625], dtype=F64))
    torch.testing.assert_close(offset[:, 2], torch.tensor([0.0, -0.03, -0.03 * 0.5625], dtype=F64))
    painted = torch.tensor([[1.0, 0.0, 0.5]], dtype=F64).expand(3, 3)
    expected = (gain * AFFINE(painted) + offset).clamp(0, 1)
    torch.testing.assert_close(transform(painted, pixel), expected)
    assert transform(painted, pixel)[0, 1] == 0


@pytest.mark.parametrize("response", [FILM, AFFINE])
@pytest.mark.parametrize("shading", [None, SHADING])
def test_a_transform_comes_back_from_json_as_it_was(response, shading):
    transform = ColourTransform(response, shading)
    again = ColourTransform.from_dict(json.loads(json.dumps(transform.to_dict())))
    assert again.to_dict() == transform.to_dict()
    pixel = torch.tensor([[3.0, 4.0]], dtype=F64).expand(27, 2)
    assert torch.equal(again(COLOURS, pixel), transform(COLOURS, pixel))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"version": 2}, "version 2"),
        ({"response": {"kind": "spline"}}, "'spline'"),
        ({"response": {"kind": "affine", "matrix": [[1.0]], "offset": [0, 0, 0]}}, "matrix"),
        ({"response": {"kind": "film", "exposure": [1, 1, 1], "contrast": float("nan"), "encoding": 1}}, "contrast"),
        ({"response": {"kind": "film", "exposure": [1, 0, 1], "contrast": 1, "encoding": 1}}, "above 0"),
        ({"response": {"kind": "film"}}, "damaged"),
        ({"response": None}, "damaged"),
        ({"shading": {"kind": "radial", "width_px": 0, "height_px": 1, "gain": 0, "offset": 0}}, "0×1"),
        ({"shading": {"kind": "table"}}, "'table'"),
    ],
)
def test_a_damaged_description_is_refused(change, message):
    with pytest.raises(ColourError, match=message):
        ColourTransform.from_dict(ColourTransform(FILM, SHADING).to_dict() | change)


def test_bad_samples_are_refused_with_the_reason():
    good = torch.full((5, 3), 0.5, dtype=F64)
    bad = good.clone()
    bad[2, 1] = torch.nan
    with pytest.raises(ColourError, match="seen colour is NaN"):
        ColourSamples(good, bad)
    with pytest.raises(ColourError, match="divide 8-bit"):
        ColourSamples(good * 255, good)
    with pytest.raises(ColourError, match="5 painted colours but 4"):
        ColourSamples(good, good[:4])
    with pytest.raises(ColourError, match="size of their picture"):
        ColourSamples(good, good, pixel=torch.zeros(5, 2))
    with pytest.raises(ColourError, match="no colour samples"):
        fit_colour(ColourSamples(good[:0], good[:0]))
    with pytest.raises(ColourError, match="samples with pixels"):
        fit_colour(ColourSamples(good, good), shading=True)


@pytest.mark.parametrize("response", [AffineResponse, FilmResponse])
def test_too_few_or_saturated_colours_are_refused(response):
    with pytest.raises(ColourError, match=r"at least (four|4)"):
        fit_colour(ColourSamples(COLOURS[:3], COLOURS[:3]), response=response)
    with pytest.raises(ColourError, match="paint"):
        fit_colour(ColourSamples(COLOURS, torch.zeros_like(COLOURS)), response=response)


def test_samples_of_pictures_are_means_of_patches_inside_the_mask():
    pictures = torch.randint(0, 256, (2, 20, 33, 3), generator=torch.Generator().manual_seed(0)).to(torch.uint8)
    mask = torch.zeros(20, 33, dtype=torch.bool)
    mask[8:16, 8:30] = True
    samples = samples_from_pictures(COLOURS[:2], pictures, mask, patch_px=8)
    assert samples.size_px == (33, 20)
    assert samples.pixel.tolist() == [[11.5, 11.5], [19.5, 11.5]] * 2
    torch.testing.assert_close(samples.seen[3], pictures[1, 8:16, 16:24].double().mean((0, 1)) / 255)
    assert torch.equal(samples.painted, COLOURS[[0, 0, 1, 1]])
    with pytest.raises(ColourError, match="no patch"):
        samples_from_pictures(COLOURS[:2], pictures, mask, patch_px=16)
    with pytest.raises(ColourError, match="3 painted colours for 2"):
        samples_from_pictures(COLOURS[:3], pictures, mask)
    with pytest.raises(ColourError, match="mask is 5×5"):
        samples_from_pictures(COLOURS[:2], pictures, mask[:5, :5])


class ShadowedRoad:
    """A canvas with soft edges, a tree's shadow across it and a post in front of it, seen in two frames."""

    def __init__(self) -> None:
        rows, columns = torch.meshgrid(torch.arange(40.0), torch.arange(60.0), indexing="ij")
        left = torch.tensor([10.3, 12.7])[:, None, None]
        across = (columns - left).clamp(0, 1) * (left + 30 - columns).clamp(0, 1)
        self.share = across * (rows - 8.4).clamp(0, 1) * (33.5 - rows).clamp(0, 1)
        self.share[:, :, 24:26] = 0.0
        light = torch.where(columns + 0.4 * rows > 34, 0.8, 0.3) - 0.002 * rows
        self.gain = (light[..., None] * torch.tensor([1.0, 0.9, 0.8])).expand(2, -1, -1, -1)
        self.offset = torch.full_like(self.gain, 0.04)
        self.clean = torch.full_like(self.gain, 0.35)

    def painted(self, *colour: float) -> torch.Tensor:
        paint = self.gain * torch.tensor(colour) + self.offset
        return ((self.clean + self.share[..., None] * (paint - self.clean)) * 255).round().to(torch.uint8)


def test_two_paints_foretell_a_third_in_shadow_at_edges_and_behind_a_post():
    road = ShadowedRoad()
    maps = pixel_maps_from_two_paints(road.painted(1, 1, 1), road.painted(0, 0, 0))
    colour = torch.tensor([0.8, 0.3, 0.1])
    paint = maps.gain * colour + maps.offset
    composite = road.clean + maps.visible[..., None] * (paint - road.clean)
    error = 255 * (composite - road.painted(*colour.tolist()).float() / 255).abs()
    assert error[maps.visible == 1].mean() < 0.6  # all of it from rounding three pictures
    assert error.mean() < 0.5
    assert error.flatten().quantile(0.995) < 12
    assert (maps.visible[:, :, 24:26] == 0).all()
    assert (maps.visible - road.share).abs().mean() < 0.01


def test_paints_that_show_nothing_are_refused():
    road = ShadowedRoad()
    light, dark = road.painted(1, 1, 1), road.painted(0, 0, 0)
    with pytest.raises(ColourError, match="same frames with both"):
        pixel_maps_from_two_paints(light, dark[:1])
    with pytest.raises(ColourError, match="do not differ"):
        pixel_maps_from_two_paints(light, light)
    with pytest.raises(ColourError, match="saturated"):
        pixel_maps_from_two_paints(torch.full_like(light, 255), dark)
    red = light.clone()
    red[..., 0] += (red[..., 0] > 120).to(torch.uint8) * (255 - red[..., 0])
    with pytest.raises(
        ColourError, match=r"\d+% of what is seen of the white paint is saturated in a channel, expected"
    ):
        pixel_maps_from_two_paints(red, dark)


def real_renders(folder: Path, keys: list[int]) -> tuple[torch.Tensor, torch.Tensor]:
    with (folder / "colours.csv").open() as file:
        painted = {int(row["index"]): [float(row[c]) / 255 for c in "rgb"] for row in csv.DictReader(file)}
    pictures = np.stack([np.asarray(Image.open(folder / "real" / f"{key}.png").convert("RGB")) for key in keys])
    return torch.tensor([painted[key] for key in keys], dtype=F64), torch.from_numpy(pictures)


def test_unseen_hues_of_real_renders_are_predicted_within_three_and_a_half_levels(carla_data):
    folder = carla_data / "colour"
    mask = torch.from_numpy(np.asarray(Image.open(folder / "painted_mask.png").convert("L")) > 0)
    keys = [1, 2, 7, 8, 13, 14, 17, 18, 19, 20]
    painted, pictures = real_renders(folder, keys)
    samples = samples_from_pictures(painted, pictures, mask, group=torch.tensor(keys).add(1) // 2, patch_px=32)
    fit = fit_colour(samples, shading=True)
    assert fit.report.model == "film + radial shading"
    assert fit.report.left_out < fit_colour(samples, response=AffineResponse, shading=True).report.left_out / 2
    colours, renders = real_renders(folder, [5, 6, 11, 12])
    row, column = mask.nonzero(as_tuple=True)
    seen = fit.transform(
        colours[:, None].expand(-1, len(row), -1), torch.stack([column, row], 1).double().expand(4, -1, -1)
    )
    assert (255 * seen - renders[:, row, column]).abs().mean() < 2.5

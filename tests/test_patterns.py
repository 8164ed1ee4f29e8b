"""Patterns: the published numbers, the partition of visibility, rasters and files."""

import json

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from PIL import Image

from references import rectangles_from_published
from roadproof.coverage import Shape, polygon_vertices
from roadproof.errors import OutputError, PatternError
from roadproof.patterns import (
    Pattern,
    boxes_from_published,
    load_pattern,
    raster,
    read_paint,
    save_pattern,
    visibilities,
)

# The released code's first two rectangles for seed 1801: rotation, position, width, length, r, g, b.
PUBLISHED = [[70.5, 291.5, 56.7, 37.7, 143.2, 196.7, 112.2], [154.4, 276.0, 44.0, 0.8, 8.4, 150.4, 193.1]]


def released_corners(rotation_deg, position, width, length):
    """Corners as the released code draws them, before it truncates them to integers."""
    x0, w, inset = position + 10, 5 + width, 5 + length
    corners = np.array([[x0, inset], [x0 + w, inset], [x0 + w, 400 - inset], [x0, 400 - inset]])
    centre = np.array([x0 + w / 2, 200.0])
    a = np.radians(rotation_deg)
    return (corners - centre) @ np.array([[np.cos(a), np.sin(a)], [-np.sin(a), np.cos(a)]]) + centre


def test_published_rectangles_have_the_released_codes_corners():
    pattern = rectangles_from_published(PUBLISHED)
    for row, box in zip(PUBLISHED, pattern.boxes, strict=True):
        np.testing.assert_allclose(
            polygon_vertices(Shape.RECTANGLE, box).numpy(), released_corners(*row[:4]), atol=1e-3
        )
    np.testing.assert_allclose(pattern.colours[1].numpy() * 255, PUBLISHED[1][4:], atol=1e-4)


def test_published_sizes_span_the_ranges_of_the_released_code():
    small, large = boxes_from_published(torch.tensor([[0.0, 0.0, 0.0, 70.0], [180.0, 380.0, 100.0, 0.0]]))
    assert (small[2], small[3]) == (5.0, 250.0)
    assert (large[2], large[3]) == (105.0, 390.0)
    assert large[0] == 442.5


def test_rotation_about_the_canvas_turns_the_centre_too():
    values = torch.tensor([[90.0, 285.0, 5.0, 0.0]])  # centre at (300, 200) before rotation
    x, y, *_ = boxes_from_published(values, rotate_about="canvas")[0]
    assert (float(x), float(y)) == pytest.approx((200.0, 300.0), abs=1e-3)
    x, y, *_ = boxes_from_published(values)[0]
    assert (float(x), float(y)) == (300.0, 200.0)


def test_four_parameters_mean_black():
    assert rectangles_from_published([[20.0, 100.0, 30.0, 10.0]]).colours.abs().max() == 0


@given(st.integers(1, 7), st.integers(0, 10_000))
@settings(max_examples=60, deadline=None, derandomize=True)
def test_visibilities_and_the_bare_road_are_a_partition(figures, seed):
    masks = torch.rand(3, figures, 11, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
    seen = visibilities(masks)
    assert (seen >= 0).all()
    torch.testing.assert_close(seen.sum(-2), 1 - (1 - masks).prod(-2))
    torch.testing.assert_close(seen[:, -1], masks[:, -1])


def test_visibilities_of_fractional_masks_do_not_exceed_one_as_the_papers_recursion_would():
    seen = visibilities(torch.tensor([[1.0], [0.5], [0.5]]))
    assert seen[:, 0].tolist() == [0.25, 0.25, 0.5]


def test_visibilities_of_binary_masks_are_the_papers():
    masks = torch.randint(0, 2, (4, 50), generator=torch.Generator().manual_seed(0)).double()
    paper = torch.zeros_like(masks)
    for k in reversed(range(4)):
        paper[k] = masks[k] * (1 - paper[k + 1 :]).prod(0)
    torch.testing.assert_close(visibilities(masks), paper)


def test_the_raster_shows_the_last_figure_on_top_and_leaves_the_rest_transparent():
    red_then_blue = Pattern(
        (Shape.RECTANGLE, Shape.RECTANGLE),
        torch.tensor([[200.0, 200.0, 200.0, 200.0, 0.0], [200.0, 200.0, 100.0, 100.0, 0.0]]),
        torch.tensor([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0]]),
    )
    picture = raster(red_then_blue)
    assert picture.shape == (400, 400, 4)
    assert picture[200, 200].tolist() == [0, 0, 255, 255]
    assert picture[200, 120].tolist() == [255, 0, 0, 255]
    assert picture[20, 20, 3] == 0


@pytest.mark.parametrize("size", [100, 400, 777])
def test_the_raster_covers_the_same_share_at_any_size(size):
    pattern = rectangles_from_published([PUBLISHED[1]])
    inside_canvas = raster(pattern, 1600)[..., 3].mean() / 255
    assert raster(pattern, size)[..., 3].mean() / 255 == pytest.approx(inside_canvas, abs=3e-4)


def test_a_saved_pattern_is_the_same_when_loaded(tmp_path):
    pattern = Pattern((Shape.ELLIPSE, Shape.TRIANGLE), torch.rand(2, 5) * 100 + 20, torch.rand(2, 3))
    save_pattern(pattern, tmp_path / "deep" / "pattern.json")
    loaded = load_pattern(tmp_path / "deep" / "pattern.json")
    assert loaded.shapes == pattern.shapes
    torch.testing.assert_close(loaded.boxes, pattern.boxes, rtol=0, atol=0)
    torch.testing.assert_close(loaded.colours, pattern.colours, rtol=0, atol=0)
    assert sorted(path.name for path in (tmp_path / "deep").iterdir()) == ["pattern.json", "pattern.png"]


def valid_file():
    figure = {"shape": "rectangle", "x_px": 1, "y_px": 2, "width_px": 3, "length_px": 4, "rotation_deg": 5}
    return {"format": "roadproof-pattern", "version": 1, "figures": [figure | {"rgb": [0, 0.5, 1]}]}


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda c: c.update(format="other"), "format 'other'"),
        (lambda c: c.update(version=99), "version 99"),
        (lambda c: c.update(figures=[]), "it has 0 figures, expected at least one"),
        (lambda c: c["figures"][0].update(shape="blob"), r"figures: Invalid enum value 'blob' - at `\$\[0\]\.shape`"),
        (lambda c: c["figures"][0].pop("x_px"), "required field `x_px`"),
        (lambda c: c["figures"][0].update(rgb=[0, 0, 7]), r"\[0, 1\]"),
        (lambda c: c["figures"][0].update(width_px=-3), "above 0"),
        (lambda c: c["figures"][0].update(y_px=float("nan")), "NaN is no finite number"),
        (
            lambda c: c["figures"][0].update(x_px=1e39),
            r"has 1e\+39, expected at most 100000 px or degrees - at `\$\[0\]`",
        ),
        (lambda c: c["figures"][0].update(x_px=10**400), "401 digits"),
        (lambda c: c.update(figures=c["figures"] * 65), "has 65 figures, expected at least one and 64 at most"),
        (lambda c: c.update(version=True), "version True, expected a whole number from 1"),
        (lambda c: c.update(version=-1), "version -1"),
        (lambda c: c.update(canvas_px=401), "canvas_px is 401, expected 400"),
        (lambda c: c.update(figures=c["figures"] * 5000), "it is larger than 262,144 bytes"),
    ],
)
def test_a_damaged_pattern_file_is_refused_in_one_line(tmp_path, change, message):
    content = valid_file()
    change(content)
    (tmp_path / "pattern.json").write_text(json.dumps(content))
    with pytest.raises(PatternError, match=message) as caught:
        load_pattern(tmp_path / "pattern.json")
    assert "\n" not in str(caught.value)


def test_files_that_are_missing_or_no_json_are_refused(tmp_path):
    with pytest.raises(PatternError, match="No such file"):
        load_pattern(tmp_path / "none.json")
    (tmp_path / "deep.json").write_text("[" * 100_000)
    with pytest.raises(PatternError, match="not valid JSON"):
        load_pattern(tmp_path / "deep.json")
    (tmp_path / "text.json").write_text("hello")
    with pytest.raises(PatternError, match="not valid JSON"):
        load_pattern(tmp_path / "text.json")


@pytest.mark.parametrize("name", ["x.png", "x", "x.npz"])
def test_figures_are_written_as_json_alone_beside_their_picture(tmp_path, name):
    pattern = Pattern((Shape.ELLIPSE,), torch.full((1, 5), 50.0), torch.rand(1, 3))
    with pytest.raises(PatternError, match=f"{name} does not end in .json; give such a path"):
        save_pattern(pattern, tmp_path / name)
    assert not any(tmp_path.iterdir())


def test_a_folder_that_cannot_be_made_is_named(tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(OutputError, match="file"):
        save_pattern(rectangles_from_published(PUBLISHED), tmp_path / "file" / "pattern.json")


def test_patterns_need_figures_of_equal_number():
    with pytest.raises(PatternError, match="expected K"):
        Pattern((), torch.zeros(0, 5), torch.zeros(0, 3))
    with pytest.raises(PatternError, match="4 \\(black\\) or 7"):
        rectangles_from_published([[1.0, 2.0]])


def test_paint_is_read_from_a_pattern_or_from_a_picture(tmp_path):
    pattern = rectangles_from_published(PUBLISHED)
    save_pattern(pattern, tmp_path / "pattern.json")
    for name in ("pattern.json", "pattern.png"):
        np.testing.assert_array_equal(read_paint(tmp_path / name), raster(pattern))
    Image.new("RGB", (400, 400), (1, 2, 3)).save(tmp_path / "own.png")
    np.testing.assert_array_equal(read_paint(tmp_path / "own.png")[7, 9], [1, 2, 3, 255])


def test_what_cannot_be_painted_is_refused(tmp_path):
    Image.new("RGB", (400, 300)).save(tmp_path / "low.png")
    (tmp_path / "text.png").write_text("not a picture")
    for name, message in (("low.png", "400×300 pixels"), ("text.png", "cannot be read"), ("none.png", "is missing")):
        with pytest.raises(PatternError, match=message):
            read_paint(tmp_path / name)


def test_a_batch_or_a_pattern_that_is_not_finite_is_neither_painted_nor_saved(tmp_path):
    box, colour = torch.tensor([[200.0, 200.0, 40.0, 100.0, 0.0]]), torch.zeros(1, 3)
    for wrong, message in {
        Pattern((Shape.RECTANGLE,), box * torch.nan, colour): "boxes of the pattern are not finite",
        Pattern((Shape.RECTANGLE,), box, colour + torch.inf): "colours of the pattern are not finite",
        Pattern((Shape.RECTANGLE,), box[None], colour[None]): r"expected one pattern, got a batch of shape \(1,\)",
    }.items():
        with pytest.raises(PatternError, match=message):
            raster(wrong)
        with pytest.raises(PatternError, match=message):
            save_pattern(wrong, tmp_path / "pattern.json")
    assert not list(tmp_path.iterdir())

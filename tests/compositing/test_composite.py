"""Compositing: the partition, exact gradients, batches, edges of the canvas."""

import numpy as np
import pytest
import torch

from references import approach
from roadproof.compositing import Compositor, composite, view_canvas
from roadproof.compositing.composite import blend, canvas_colours, dense_colours
from roadproof.compositing.view import canvas_pixels
from roadproof.coverage import Footprints, Shape, canvas_share, footprint_variance
from roadproof.datatypes import VehicleState
from roadproof.errors import GeometryError, PatternError
from roadproof.geometry import CIL_INPUT, CameraModel, CanvasPlacement, CropResize, homography_from_pose, sight
from roadproof.patterns import Pattern, coverages, visibilities
from roadproof.photometry import AffineResponse, ColourTransform, PixelMaps
from roadproof.search_space import SearchSpace
from scenes import PLAIN, road_frames

DIM = ColourTransform(AffineResponse(torch.eye(3) * 0.6, torch.full((3,), 0.05)))


def make_view(frames=3, dtype=torch.float64, colour=DIM, **kwargs):
    return view_canvas(road_frames(frames, 0), approach(frames), CIL_INPUT, colour, dtype=dtype, **kwargs)


def random_patterns(batch=(2,), figures=4, seed=0, dtype=torch.float64, **kwargs):
    space = SearchSpace(figures=figures, **kwargs)
    unit = space.random(batch, torch.Generator().manual_seed(seed)).to(dtype)
    return space, unit


def whole_canvas(colour):
    return Pattern((Shape.RECTANGLE,), torch.tensor([[199.5, 199.5, 400.0, 400.0, 0.0]]), torch.tensor([colour]))


def test_the_hand_written_gradient_is_that_of_plain_tensor_operations():
    view = make_view()
    space, unit = random_patterns()
    unit.requires_grad_()
    pattern = space.pattern(unit)
    fast = canvas_colours(pattern, view)
    again = space.pattern(unit)
    seen = view.response(again.colours)
    plain = blend(visibilities(coverages(again, view.footprints)), seen, view)
    torch.testing.assert_close(fast, plain, rtol=0, atol=1e-12)
    weight = torch.randn(plain.shape, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    (by_hand,) = torch.autograd.grad((fast * weight).sum(), unit)
    (reference,) = torch.autograd.grad((plain * weight).sum(), unit)
    torch.testing.assert_close(by_hand, reference, rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize("shape", list(Shape))
def test_dense_painting_and_its_gradient_are_those_of_sparse_painting(shape):
    view = make_view()
    space, unit = random_patterns(family="free", shape=shape)
    weight = torch.randn(2, len(view.clean), 3, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    found = []
    for paint in (dense_colours, canvas_colours):
        leaf = unit.clone().requires_grad_()
        colours = paint(space.pattern(leaf), view)
        found.append((colours, torch.autograd.grad((colours * weight).sum(), leaf)[0]))
    torch.testing.assert_close(found[0][0], found[1][0], rtol=0, atol=1e-12)
    torch.testing.assert_close(found[0][1], found[1][1], rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize("shape", list(Shape))
def test_gradients_of_composited_frames_are_exact(shape):
    view = make_view(frames=1)
    space, unit = random_patterns(batch=(1,), figures=2, family="free", shape=shape)
    weight = torch.randn(1, 1, 3, 88, 200, generator=torch.Generator().manual_seed(2), dtype=torch.float64)
    function = lambda point: (composite(space.pattern(point), view) * weight).sum()  # noqa: E731
    assert torch.autograd.gradcheck(function, (unit.requires_grad_(),), eps=1e-6, atol=1e-4)


def test_pixels_off_the_canvas_are_copied_bit_for_bit():
    view = make_view(dtype=torch.float32)
    space, unit = random_patterns(batch=(), dtype=torch.float32)
    frames = composite(space.pattern(unit), view).permute(0, 2, 3, 1).reshape(-1, 3)
    outside = torch.ones(len(frames), dtype=torch.bool)
    outside[view.index] = False
    assert torch.equal(frames[outside], view.frames.reshape(-1, 3)[outside])
    assert not torch.equal(frames[~outside], view.clean)


def test_a_wholly_painted_canvas_shows_the_seen_colour():
    view = make_view(dtype=torch.float32)
    frames = composite(whole_canvas([0.5, 1.0, 0.0]), view)
    expected = torch.tensor([0.35, 0.65, 0.05])
    from_above = view.footprints.centre
    middle = ((from_above > 60) & (from_above < 340)).all(-1)
    painted = frames.permute(0, 2, 3, 1).reshape(-1, 3)[view.index[middle]]
    torch.testing.assert_close(painted, expected.expand_as(painted), rtol=0, atol=1e-3)


def test_figures_are_cut_off_at_the_edge_of_the_canvas():
    view = make_view(dtype=torch.float32)
    beyond = Pattern(
        (Shape.RECTANGLE,), torch.tensor([[440.0, 200.0, 50.0, 390.0, 0.0]]), torch.tensor([[1.0, 0.0, 0.0]])
    )
    everywhere = whole_canvas([1.0, 0.0, 0.0])
    huge = Pattern(everywhere.shapes, everywhere.boxes * torch.tensor([1, 1, 3, 3, 1]), everywhere.colours)
    changed = lambda p: (canvas_colours(p, view) - view.clean).abs().sum()  # noqa: E731
    assert changed(beyond) < 0.02 * changed(everywhere)
    torch.testing.assert_close(canvas_colours(huge, view), canvas_colours(everywhere, view), atol=0.3, rtol=0)
    assert changed(huge) < 1.05 * changed(everywhere)


def test_a_batch_of_patterns_is_the_patterns_one_by_one():
    view = make_view()
    space, unit = random_patterns(batch=(3, 2))
    together = composite(space.pattern(unit), view)
    for i in range(3):
        for j in range(2):
            torch.testing.assert_close(together[i, j], composite(space.pattern(unit[i, j]), view))


def test_a_compositor_paints_many_views_again_and_again():
    views = [make_view(2), make_view(3)]
    compositor = Compositor(views, copies=2)
    for seed in (0, 1):
        space, unit = random_patterns(batch=(2, 2), seed=seed)
        frames = compositor([space.pattern(part) for part in unit])
        expected = [composite(space.pattern(part), view).flatten(0, 1) for part, view in zip(unit, views, strict=True)]
        torch.testing.assert_close(frames, torch.cat(expected))


def test_the_same_pattern_gives_the_same_pixels():
    view = make_view(dtype=torch.float32)
    space, unit = random_patterns(dtype=torch.float32)
    assert torch.equal(composite(space.pattern(unit), view), composite(space.pattern(unit), view))


def test_far_and_slanted_footprints_never_give_nan():
    far = approach(3, first_m=60.0, last_m=30.0)
    view = view_canvas(road_frames(3, 0), far, CIL_INPUT, PLAIN)
    space, unit = random_patterns(batch=(64,), dtype=torch.float32)
    leaf = unit.requires_grad_()
    frames = composite(space.pattern(leaf), view)
    (gradient,) = torch.autograd.grad(frames.sum(), leaf)
    assert frames.isfinite().all()
    assert gradient.isfinite().all()


def test_pixel_maps_give_every_pixel_its_own_light():
    count = 2
    gain = torch.full((count, 88, 200, 3), 0.5)
    gain[:, :, 100:] = 0.25
    maps = PixelMaps(gain, torch.zeros_like(gain), torch.ones(count, 88, 200))
    view = make_view(count, dtype=torch.float32, colour=PLAIN, maps=maps)
    frames = composite(whole_canvas([1.0, 1.0, 1.0]), view)
    row = frames[-1, 0, 60]
    assert row[80:95].tolist() == pytest.approx([0.5] * 15, abs=1e-4)
    assert row[105:120].tolist() == pytest.approx([0.25] * 15, abs=1e-4)


@pytest.mark.parametrize("size", [(100, 44), (200, 88), (400, 176), (600, 264)])
def test_no_pixel_that_shows_paint_stays_bare_where_the_input_is_larger_or_smaller_than_its_crop(size):
    camera = CameraModel(width_px=200, height_px=150, fov_deg=100.0, forward_m=2.0, up_m=1.4, pitch_deg=-15.0)
    view = CropResize(left_px=0, top_px=40, right_px=200, bottom_px=128, width_px=size[0], height_px=size[1])
    canvas = CanvasPlacement(x_m=12.0, y_m=0.0, width_m=3.5, length_m=6.0)
    homography = homography_from_pose(camera, VehicleState(0.0, 0.0), canvas)
    taken, *_ = canvas_pixels(homography[None], view)
    inverse = np.linalg.inv(view.input_from_camera @ homography)
    through, bend = sight(view)
    mapped = (inverse @ through).T
    ahead = mapped[:, 2] > 0
    centre = mapped[ahead, :2] / mapped[ahead, 2:]
    slope = (inverse[:2] - centre[:, :, None] * inverse[2:]) @ bend[ahead]
    whole = Footprints.of(centre, slope / mapped[ahead, 2][:, None, None], footprint_variance(view))
    share = torch.zeros(view.width_px * view.height_px)
    share[np.flatnonzero(ahead)] = canvas_share(whole).float()
    share[torch.as_tensor(taken)] = 0.0
    assert share.max() < 0.02


def test_frames_that_do_not_show_the_canvas_are_refused():
    behind = approach(2, first_m=-30.0, last_m=-40.0)
    with pytest.raises(GeometryError, match="no frame shows the canvas"):
        view_canvas(road_frames(2, 0), behind, CIL_INPUT, PLAIN)


@pytest.mark.gpu
@pytest.mark.skipif(not torch.cuda.is_available(), reason="this torch sees no CUDA device")
def test_cuda_gives_the_cpus_frames_and_gradients():
    space, unit = random_patterns(dtype=torch.float32)
    results = []
    for device in ("cpu", "cuda"):
        leaf = unit.to(device).requires_grad_()
        frames = composite(space.pattern(leaf), make_view(dtype=torch.float32, device=device))
        results.append((frames.cpu(), torch.autograd.grad(frames.square().sum(), leaf)[0].cpu()))
    torch.testing.assert_close(results[0][0], results[1][0], atol=1e-4, rtol=0)
    torch.testing.assert_close(results[0][1], results[1][1], atol=1e-2, rtol=1e-3)


def test_visibility_of_composited_figures_is_a_partition_on_real_homographies(carla_data):
    stored = np.load(carla_data / "t1" / "homographies.npz", allow_pickle=False)
    view = view_canvas(road_frames(25, 0), stored["H"], CIL_INPUT, PLAIN)
    space, unit = random_patterns(figures=5, dtype=torch.float32)
    masks = coverages(space.pattern(unit), view.footprints)
    assert float(masks.min()) >= 0
    assert float(masks.max()) <= 1 + 1e-6
    torch.testing.assert_close(visibilities(masks).sum(-2), 1 - (1 - masks).prod(-2), atol=1e-6, rtol=0)


def test_a_controller_may_write_into_the_frames_that_it_is_given():
    view, space = make_view(dtype=torch.float32), SearchSpace(figures=2)
    pattern = space.drawn(2, 0)
    compositor = Compositor([view], copies=2)
    expected = compositor([pattern]).clone()
    for wants in (True, False):
        boxes = pattern.boxes.clone().requires_grad_(wants)
        shown = compositor([Pattern(pattern.shapes, boxes, pattern.colours)])
        assert torch.equal(shown, expected)
        shown.sub_(0.5)
    assert torch.equal(compositor([pattern]), expected)


def test_as_many_patterns_are_painted_as_there_are_copies():
    view, space = make_view(dtype=torch.float32), SearchSpace(figures=2)
    with pytest.raises(PatternError, match="given 3 patterns, expected the compositor's 2"):
        Compositor([view], copies=2)([space.drawn(3, 0)])

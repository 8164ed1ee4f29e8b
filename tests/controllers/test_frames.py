"""Frame preparation against OpenCV's published values and Pillow's exact box filter."""

import numpy as np
import pytest
import torch
from PIL import Image

from roadproof.controllers import FramePreparation
from roadproof.controllers.frames import one_frame_batch, resize_by_area, yuv_from_rgb
from roadproof.errors import ControllerError

# Computed once with OpenCV 4: cv2.cvtColor(rgb, cv2.COLOR_RGB2YUV); the pure colours saturate.
OPENCV_RGB_YUV = [
    ((0, 0, 0), (0, 128, 128)),
    ((255, 255, 255), (255, 128, 128)),
    ((255, 0, 0), (76, 91, 255)),
    ((0, 255, 0), (150, 54, 0)),
    ((0, 0, 255), (29, 239, 103)),
    ((0, 255, 255), (179, 165, 0)),
    ((204, 81, 81), (118, 110, 203)),
    ((51, 127, 127), (104, 139, 82)),
    ((10, 200, 90), (131, 108, 22)),
]


@pytest.mark.parametrize(("rgb", "yuv"), OPENCV_RGB_YUV)
def test_yuv_is_opencvs_within_its_rounding(rgb, yuv):
    colour = torch.tensor(rgb, dtype=torch.float64)[None, :, None, None] / 255
    np.testing.assert_allclose(yuv_from_rgb(colour)[0, :, 0, 0].numpy() * 255, yuv, atol=1.0)


@pytest.mark.parametrize(("height", "width"), [(66, 20), (33, 7), (75, 13), (1, 1)])
def test_resizing_averages_the_exact_footprint(height, width):
    picture = np.random.default_rng(0).uniform(0, 1, (75, 32))
    # Every pixel repeated so often that the new pixels hold whole numbers of repetitions.
    fine = np.kron(picture, np.ones((height, width)))
    expected = fine.reshape(height, 75, width, 32).mean(axis=(1, 3))
    resized = resize_by_area(torch.tensor(picture)[None, None].expand(1, 3, -1, -1), (height, width))
    np.testing.assert_allclose(resized[0, 1].numpy(), expected, atol=1e-12)


def test_whole_number_reduction_is_pillows_box():
    picture = np.random.default_rng(0).integers(0, 256, (88, 200), dtype=np.uint8)
    expected = np.asarray(Image.fromarray(picture.astype(np.float32)).resize((50, 22), Image.Resampling.BOX))
    frames = torch.tensor(picture).float()[None, None].expand(1, 3, -1, -1)
    np.testing.assert_allclose(resize_by_area(frames, (22, 50))[0, 0].numpy(), expected, atol=1e-3)


def test_preparation_keeps_rows_then_scales():
    prepare = FramePreparation(frame_size=(88, 200), rows=(15, 81), mean=(0.5,) * 3, std=(0.5,) * 3)
    frames = torch.rand(2, 3, 88, 200, generator=torch.Generator().manual_seed(0))
    torch.testing.assert_close(prepare(frames), frames[:, :, 15:81] * 2 - 1)


def test_the_whole_preparation_has_exact_gradients():
    prepare = FramePreparation(
        rows=(1, 7), network_size=(4, 3), colour="yuv", mean=(0.5, 0.4, 0.3), std=(0.5, 0.6, 0.7)
    )
    frames = torch.rand(1, 3, 8, 5, generator=torch.Generator().manual_seed(0), dtype=torch.float64) * 0.4 + 0.3
    assert torch.autograd.gradcheck(prepare, frames.requires_grad_())


def test_nothing_asked_for_changes_nothing():
    frames = torch.rand(1, 3, 4, 5, generator=torch.Generator().manual_seed(0))
    assert torch.equal(FramePreparation()(frames), frames)


def test_one_frame_becomes_a_batch_in_unit_range():
    frame = np.random.default_rng(0).integers(0, 256, (4, 5, 3), dtype=np.uint8)
    frames, speed, command = one_frame_batch(torch.nn.Identity(), frame, 6.0, 2)
    np.testing.assert_allclose(frames[0].permute(1, 2, 0).numpy() * 255, frame, atol=1e-4)
    assert (speed.tolist(), command.tolist()) == ([6.0], [2])


def test_one_frame_goes_where_the_network_is_also_if_all_it_has_are_buffers():
    frozen = torch.nn.BatchNorm2d(3, affine=False).to("meta")
    batch = one_frame_batch(frozen, np.zeros((4, 5, 3), np.uint8), 6.0, 2)
    assert {each.device.type for each in batch} == {"meta"}


@pytest.mark.parametrize(
    ("kwargs", "message"),
    [
        ({"frame_size": (0, 200)}, "frame_size is 0×200"),
        ({"network_size": (66, -1)}, "network_size is 66×-1"),
        ({"frame_size": (88, 200), "rows": (15, 89)}, "88 rows"),
        ({"rows": (20, 20)}, "rows are"),
        ({"colour": "hsv"}, "colour is 'hsv'"),
        ({"std": (1.0, 0.0, 1.0)}, "std is"),
    ],
)
def test_impossible_preparations_are_refused(kwargs, message):
    with pytest.raises(ControllerError, match=message):
        FramePreparation(**kwargs)


def test_frames_that_do_not_fit_are_refused():
    with pytest.raises(ControllerError, match="rows up to 81"):
        FramePreparation(rows=(15, 81))(torch.zeros(1, 3, 66, 200))
    with pytest.raises(ControllerError, match="takes 200×88"):
        FramePreparation(frame_size=(88, 200))(torch.zeros(1, 3, 66, 200))


def test_few_digits_of_a_network_are_not_those_of_its_input():
    frames = torch.rand(1, 3, 4, 5, generator=torch.Generator().manual_seed(0))
    expected = yuv_from_rgb(frames)
    with torch.autocast("cpu", torch.bfloat16):
        assert torch.equal(yuv_from_rgb(frames), expected)

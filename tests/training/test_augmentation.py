"""Pictures vary as asked, stay pictures, and vary alike for the same seed."""

import pytest
import torch

from roadproof.training.augmentation import Augmentation

NONE = dict.fromkeys(Augmentation.__slots__, 0.0)
NOTHING = Augmentation(**NONE)


def pictures(count=16):
    return torch.rand(count, 3, 20, 30, generator=torch.Generator().manual_seed(0)) * 0.9 + 0.05


def seeded(seed=1):
    return torch.Generator().manual_seed(seed)


def test_nothing_asked_changes_nothing():
    torch.testing.assert_close(NOTHING(pictures(), seeded()), pictures())


def test_the_same_seed_varies_alike_and_another_does_not():
    vary = Augmentation()
    one, same, other = vary(pictures(), seeded(1)), vary(pictures(), seeded(1)), vary(pictures(), seeded(2))
    torch.testing.assert_close(one, same, rtol=0, atol=0)
    assert not torch.equal(one, other)
    assert (one.min(), one.max()) >= (0.0, 0.0)
    assert one.max() <= 1.0
    assert one.isfinite().all()


def test_the_input_is_left_alone():
    before = pictures()
    given = before.clone()
    Augmentation(blurred=1.0, noisy=1.0)(given, seeded())
    torch.testing.assert_close(given, before, rtol=0, atol=0)


@pytest.mark.parametrize("name", ["brightness", "contrast", "tint", "saturation"])
def test_each_variation_does_what_it_is_called(name):
    before = pictures() * 0.3 + 0.35
    after = Augmentation(**{**NONE, name: 0.1})(before, seeded())
    if name == "brightness":  # one factor on everything
        ratio = after / before
        torch.testing.assert_close(ratio, ratio[:, :1, :1, :1].expand_as(ratio))
        assert ratio.std() > 0.03
    elif name == "contrast":
        torch.testing.assert_close(after.mean(dim=(1, 2, 3)), before.mean(dim=(1, 2, 3)))
        assert (after.var(dim=(1, 2, 3)) / before.var(dim=(1, 2, 3))).std() > 0.03
    elif name == "tint":  # one factor on each channel
        ratio = after / before
        torch.testing.assert_close(ratio, ratio[:, :, :1, :1].expand_as(ratio))
        assert ratio[:, :, 0, 0].std(dim=1).min() > 0.0
    else:  # saturation: grey stays
        torch.testing.assert_close(after.mean(dim=1), before.mean(dim=1))
        assert (after - before).abs().max() > 0.01


def test_noise_and_blur_touch_their_share_of_the_pictures():
    many = pictures(400)
    for changes, share in (({"noise": 0.1, "noisy": 0.3}, 0.3), ({"blurred": 0.15}, 0.15)):
        after = Augmentation(**(NONE | changes))(many, seeded())
        touched = ((after - many).abs().amax(dim=(1, 2, 3)) > 1e-5).float().mean()
        assert abs(float(touched) - share) < 0.08


def test_blur_is_the_mean_of_nine():
    before = pictures(2)
    after = Augmentation(**(NONE | {"blurred": 1.0}))(before, seeded())
    torch.testing.assert_close(after[1, 2, 7, 9], before[1, 2, 6:9, 8:11].mean())


def test_a_window_has_one_light_and_each_picture_its_own_noise():
    before = pictures(1).repeat(6, 1, 1, 1)
    light = Augmentation(**(NONE | {"brightness": 0.3, "tint": 0.2, "saturation": 0.3}))(before, seeded(), window=3)
    torch.testing.assert_close(light[0].expand(3, -1, -1, -1), light[:3])
    assert not torch.allclose(light[0], light[3])
    noisy = Augmentation(**(NONE | {"noise": 0.1, "noisy": 1.0}))(before, seeded(), window=3)
    assert not torch.allclose(noisy[0], noisy[1])

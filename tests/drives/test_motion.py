"""Speed and yaw rate from pictures of a made-up ground, drawn pixel by pixel from where the car is known to be."""

import math
from dataclasses import replace

import numpy as np
import pytest
from PIL import Image
from scipy import ndimage

from lenses import ACTION, BARREL
from own_drives import write_table
from roadproof.datatypes import VehicleState
from roadproof.drives.own import import_drives
from roadproof.drives.own.motion import motion_of
from roadproof.errors import RecordingError
from roadproof.geometry import CameraModel, CropResize

DT_S = 0.1
CAMERA = CameraModel(width_px=200, height_px=150, fov_deg=70.0, forward_m=1.7, up_m=1.3, pitch_deg=-12.0)
VIEW = CropResize(left_px=0, top_px=50, right_px=200, bottom_px=150, width_px=200, height_px=66)
PER_M = 12
PLAN = """
dt_s = 0.1
camera = { width_px = 200, height_px = 150, fov_deg = 70.0, forward_m = 1.7, up_m = 1.3, pitch_deg = -12.0 }
input = { left_px = 0, top_px = 50, right_px = 200, bottom_px = 150, width_px = 200, height_px = 66 }
canvas = { ahead_m = 7.0, width_m = 3.0, length_m = 3.0 }
drive = [{ name = "clean", table = "clean.csv" }]
"""


def ground(extent_m=80):
    """Asphalt with grain of several sizes, in grey levels, `PER_M` texels a metre, 10 m behind the world's origin."""
    rng = np.random.default_rng(3)
    shape = (extent_m * PER_M, extent_m * PER_M)
    grains = (ndimage.gaussian_filter(rng.standard_normal(shape), size) * size for size in (0.7, 2.0, 6.0))
    return 110 + 45 * sum(grains)


GROUND = ground()


def poses(speed_mps, rate_rad_s, count):
    """Poses of a car on arcs, in closed form: speed and yaw rate of every step, held until the next."""
    x = y = yaw = 0.0
    for k in range(count):
        yield VehicleState(x, y, 0.0, yaw, float(speed_mps[k]))
        way, turn = speed_mps[k] * DT_S, rate_rad_s[k] * DT_S
        chord = way * math.sin(turn / 2) / (turn / 2) if turn else way
        x, y, yaw = x + chord * math.cos(yaw + turn / 2), y + chord * math.sin(yaw + turn / 2), yaw + turn


def drawn(state, camera=CAMERA, nod_deg=0.0, seed=0):
    """What the camera shows of the ground, found by following each pixel's ray down to it, with noise and a shade."""
    columns, lines = np.meshgrid(np.arange(camera.width_px), np.arange(camera.height_px))
    seen, _ = camera.undistorted(np.stack([columns.ravel(), lines.ravel()], 1).astype(float))
    right, down, forth = np.linalg.solve(camera.intrinsics, seen.T)
    pitch = math.radians(camera.pitch_deg + nod_deg)
    ahead, rise = math.cos(pitch) * forth + math.sin(pitch) * down, math.sin(pitch) * forth - math.cos(pitch) * down
    far = camera.up_m / np.where(rise < -1e-3, -rise, np.nan)
    x, y = camera.forward_m + ahead * far, camera.left_m - right * far
    cos, sin = math.cos(state.yaw_rad), math.sin(state.yaw_rad)
    world = np.stack([state.x_m + cos * x - sin * y + 10, state.y_m + sin * x + cos * y + 40])
    level = ndimage.map_coordinates(GROUND, np.nan_to_num(world * PER_M, nan=-1e3), order=1, cval=160.0)
    shaded = level.reshape(lines.shape) * (0.75 + 0.5 * columns / camera.width_px)
    noise = np.random.default_rng(seed).normal(0, 2.0, shaded.shape)
    return np.repeat((shaded + noise).clip(0, 255).astype(np.uint8)[..., None], 3, 2)


def driven(count, camera=CAMERA, nod_deg=0.0, mps=6.0):
    """A drive that speeds up and bends to the left, its pictures, and its true speed and yaw rate."""
    steps = np.arange(count)
    speed, rate = mps + 0.06 * steps, 0.25 * np.sin(steps / 10)
    nods = nod_deg * np.sin(steps * 2.1)
    pictures = [drawn(s, camera, nods[k], k) for k, s in enumerate(poses(speed, rate, count))]
    return pictures, speed, rate


@pytest.mark.parametrize(
    ("camera", "nod_deg"),
    [(CAMERA, 0.0), (CAMERA, 0.15), (replace(CAMERA, lens=BARREL), 0.0), (replace(CAMERA, lens=ACTION), 0.0)],
    ids=["pinhole", "nodding", "barrel", "fisheye"],
)
def test_the_ground_gives_speed_and_yaw_rate(camera, nod_deg):
    pictures, speed, rate = driven(14, camera, nod_deg)
    found = motion_of(camera, VIEW, pictures.__getitem__, len(pictures), DT_S)
    assert np.median(found.correlation) > 0.5
    assert found.speed_mps.sum() == pytest.approx(speed.sum(), rel=0.02)
    np.testing.assert_allclose(found.speed_mps[3:-3], speed[3:-3], rtol=0.05)
    np.testing.assert_allclose(np.cumsum(found.yaw_rate_rad_s - rate) * DT_S, 0.0, atol=np.radians(1.5))


def test_a_car_that_stands_before_textured_ground_stands():
    pictures = [drawn(VehicleState(0.0, 0.0, 0.0, 0.0, 0.0), seed=k) for k in range(6)]
    found = motion_of(CAMERA, VIEW, pictures.__getitem__, 6, DT_S)
    np.testing.assert_allclose(found.speed_mps, 0.0, atol=0.05)
    np.testing.assert_allclose(found.yaw_rate_rad_s, 0.0, atol=0.01)


def test_pictures_that_do_not_tell_are_refused():
    rng = np.random.default_rng(0)
    noise = [rng.integers(0, 255, (150, 200, 3), dtype=np.uint8) for _ in range(6)]
    with pytest.raises(RecordingError, match=r"do not tell how the car moved: the ground agrees in 0 of 5 pairs"):
        motion_of(CAMERA, VIEW, noise.__getitem__, 6, DT_S)
    plain = np.full((150, 200, 3), 90, np.uint8)
    with pytest.raises(RecordingError, match=r"with a correlation of 0\.00"):
        motion_of(CAMERA, VIEW, lambda _: plain, 6, DT_S)
    with pytest.raises(RecordingError, match="2 pictures, expected 3 or more"):
        motion_of(CAMERA, VIEW, lambda _: plain, 2, DT_S)
    with pytest.raises(RecordingError, match="the camera sees 0 pixels of near ground in the box"):
        motion_of(replace(CAMERA, pitch_deg=40.0), VIEW, lambda _: plain, 6, DT_S)


def written(folder, pictures, **columns):
    """The pictures as a drive of one's own, with columns beside them."""
    folder.mkdir()
    (folder / "drives.toml").write_text(PLAN)
    for k, picture in enumerate(pictures):
        Image.fromarray(picture).save(folder / f"{k}.png")
    rows = [
        {"picture": f"{k}.png"} | {name: values[k] for name, values in columns.items()} for k in range(len(pictures))
    ]
    write_table(folder / "clean.csv", rows)
    return folder


def test_pictures_and_steering_alone_are_imported(tmp_path):
    pictures, speed, rate = driven(14)
    recordings = import_drives(written(tmp_path / "own", pictures, steer=-rate))
    track = recordings.recordings[0].track
    truth = list(poses(speed, rate, len(pictures)))
    assert (track.x_m[0], track.y_m[0], track.yaw_rad[0]) == (0.0, 0.0, 0.0)
    assert track.x_m[-1] == pytest.approx(truth[-1].x_m, abs=0.15)
    assert track.y_m[-1] == pytest.approx(truth[-1].y_m, abs=0.15)
    assert "the ground of 14 pictures, which agrees from one to the next with a correlation of 0." in recordings.origin
    stated = import_drives(written(tmp_path / "stated", pictures, steer=-rate, speed_mps=np.full(14, 7.0)))
    np.testing.assert_array_equal(stated.recordings[0].track.speed_mps, 7.0)
    with pytest.raises(
        RecordingError, match=r"the ground in the pictures moves 0\.\d\d times as fast as speed_mps says"
    ):
        import_drives(written(tmp_path / "kmh", pictures, steer=-rate, speed_mps=np.full(14, 3.6 * 7.0)))


def test_a_table_without_steering_or_with_gaps_is_refused(tmp_path):
    pictures = driven(4)[0]
    with pytest.raises(RecordingError, match="has no column steer"):
        import_drives(written(tmp_path / "own", pictures))
    folder = written(tmp_path / "gaps", pictures, steer=np.zeros(4))
    (folder / "clean.csv").write_text((folder / "clean.csv").read_text().replace("2.png", ""))
    with pytest.raises(RecordingError, match=r"clean\.csv has 3 pictures in 4 rows, expected one in each"):
        import_drives(folder)

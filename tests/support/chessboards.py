"""Pictures of a printed chessboard, drawn ray by ray through a camera that is known."""

import numpy as np
from PIL import Image
from scipy import ndimage
from scipy.spatial.transform import Rotation

CORNERS = (9, 6)
GREYS = {"black": 40.0, "white": 210.0, "behind": 110.0}


def inner(corners=CORNERS):
    """Places of the inner corners, in squares from the first, row after row, z = 0."""
    across, down = corners
    return np.array([[column, row, 0.0] for row in range(down) for column in range(across)])


def rays(camera):
    """Directions in camera axes at which the pixels look, row after row."""
    x, y = np.meshgrid(np.arange(camera.width_px), np.arange(camera.height_px))
    through, _ = camera.undistorted(np.stack([x.ravel(), y.ravel()], 1).astype(float))
    return through @ np.linalg.inv(camera.intrinsics).T


def shown(camera, pose, corners=CORNERS):
    """Where the camera shows the inner corners, px."""
    turn, place = pose
    return camera.distorted((inner(corners) @ turn.T + place) @ camera.intrinsics.T)


def poses(camera, count, seed=0, tilt_deg=(20.0, 40.0), width=(0.25, 0.6), corners=CORNERS):
    """Boards all over the picture, whole in it, each turned another way.

    Args:
        camera: camera that looks at them.
        count: number of boards.
        seed: seed of where they are.
        tilt_deg: least and most angle between the board and the direction from which it is seen.
        width: least and most width of the board, in widths of the picture.
        corners: inner corners in a row, and rows.
    """
    rng, found = np.random.default_rng(seed), []
    middle = np.array([corners[0] - 1, corners[1] - 1, 0.0]) / 2
    outline = np.array([[x, y, 0.0] for x in (-1.3, corners[0] + 0.3) for y in (-1.3, corners[1] + 0.3)])
    size = np.array([camera.width_px, camera.height_px])
    while len(found) < count:
        through, _ = camera.undistorted(rng.uniform(0.05, 0.95, (1, 2)) * size)
        aim = np.linalg.inv(camera.intrinsics) @ through[0]
        aim /= np.linalg.norm(aim)
        across = np.cross([0.0, 1.0, 0.0], aim)
        across /= np.linalg.norm(across)
        way = rng.uniform(0, 2 * np.pi)
        tilt = np.radians(rng.uniform(*tilt_deg)) * np.array([np.cos(way), np.sin(way), 0.0])
        turned = Rotation.from_rotvec(tilt) * Rotation.from_euler("z", rng.uniform(-30, 30), degrees=True)
        turn = np.stack([across, np.cross(aim, across), aim], 1) @ turned.as_matrix()
        far = (corners[0] + 1) * camera.focal_px / (rng.uniform(*width) * camera.width_px)
        place = aim * far - turn @ middle
        edge = camera.distorted((outline @ turn.T + place) @ camera.intrinsics.T)
        if (edge > 0).all() and (edge < size - 1).all():
            found.append((turn, place))
    return found


def drawn(camera, pose, looks, seed=0, blur_px=0.6, noise=2.0, corners=CORNERS):
    """The picture of a board on white paper, (H, W, 3), 8 bits.

    Args:
        camera: camera that takes the picture.
        pose: turn and place of the board.
        looks: `rays` of the camera.
        seed: seed of the noise.
        blur_px: standard deviation of the blur, px.
        noise: standard deviation of the noise, of 255 levels.
        corners: inner corners in a row, and rows.
    """
    turn, place = pose
    with np.errstate(divide="ignore", invalid="ignore"):
        hit = looks * ((turn[:, 2] @ place) / (looks @ turn[:, 2]))[:, None]
    ahead = (hit * looks).sum(1) > 0
    u, v = np.where(ahead, (turn[:, :2].T @ (hit - place).T), 1e6).reshape(2, camera.height_px, camera.width_px)
    wide, tall = (sum(np.abs(slope) for slope in np.gradient(each)) + 1e-9 for each in (u, v))

    def within(low, margin, high):
        return np.prod(
            [
                ((at - low - margin) / by + 0.5).clip(0, 1) * ((end - margin - at) / by + 0.5).clip(0, 1)
                for at, by, end in ((u, wide, high[0]), (v, tall, high[1]))
            ],
            axis=0,
        )

    edges = [(2 * (np.abs((at + 0.5) % 2 - 1) - 0.5) / by).clip(-1, 1) for at, by in ((u, wide), (v, tall))]
    dark = (1 + edges[0] * edges[1]) / 2 * within(-1, 0.0, corners)
    paper = within(-2, 0.0, (corners[0] + 1, corners[1] + 1))
    grey = GREYS["behind"] + (GREYS["white"] - GREYS["behind"]) * paper + (GREYS["black"] - GREYS["white"]) * dark
    grey = ndimage.gaussian_filter(grey, blur_px) + np.random.default_rng(seed).normal(0, noise, grey.shape)
    return np.repeat(grey.round().clip(0, 255).astype(np.uint8)[..., None], 3, -1)


def write_boards(folder, camera, boards, **how):
    """Their pictures, `00.png` and so on, in a folder."""
    folder.mkdir(parents=True, exist_ok=True)
    looks = rays(camera)
    for k, pose in enumerate(boards):
        Image.fromarray(drawn(camera, pose, looks, seed=k, **how)).save(folder / f"{k:02}.png")
    return folder

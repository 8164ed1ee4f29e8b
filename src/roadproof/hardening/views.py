"""What a controller is tuned on: pictures from around the ways it takes past the canvas, bare and painted.

A street is the recorded world of one scenario. Its poses are those of drives predicted in it, over the bare road and
over every pattern that was found there, each moved aside, turned and made faster or slower by a drawn amount. Any
pattern can be painted there, whichever street it was found on.
"""

from __future__ import annotations

from typing import NamedTuple, cast

import torch
from jaxtyping import Float, Int
from torch import Tensor

from roadproof.compositing.composite import composite_own
from roadproof.compositing.view import OwnViews
from roadproof.controllers import Controller
from roadproof.patterns import Pattern
from roadproof.recorded import RecordedWorld
from roadproof.recorded.course import Place
from roadproof.recorded.nearest import Poses
from roadproof.recordings import RecordingSet

MOVED_M, TURNED_RAD, FASTER_MPS = 0.4, 0.06, 0.7
"""Standard deviations of what poses are moved by."""

AHEAD_M, LEFT_M, TURN_RAD = 1.5, 1.5, 0.4
"""A pose further from every recorded one is left out: its picture says little."""

LEAST_COVER = 0.05
"""Of the pictures to paint, one whose canvas is out of sight is drawn as often as one with so much of it."""

RECORDED_M = 1.5
"""How far aside drives are recorded; the law of steering is not believed beyond."""


class Views(NamedTuple):
    """Pictures of the bare road from B poses.

    Args:
        frames: RGB in [0, 1].
        speed_mps: speed of the car at each picture.
        command: command at each picture, in CARLA's codes.
        place: where the car is at each picture, relative to a street's clean path; None where there is no such path.
        canvas: where each picture shows a canvas; None where no picture shows one.
    """

    frames: Float[Tensor, "b 3 h w"]
    speed_mps: Float[Tensor, " b"]
    command: Int[Tensor, " b"]
    place: Place | None
    canvas: OwnViews | None

    def painted(self, pattern: Pattern) -> Float[Tensor, "b 3 h w"]:
        """The pictures with a pattern of its own in each, differentiable in the patterns."""
        return self.frames if self.canvas is None else composite_own(pattern, self.frames, self.canvas)


class Street:
    """A recorded world, and the poses that matter there.

    Args:
        recordings: a calibrated set of recordings with a canvas and tracks.
        teacher: the controller whose law of steering on the bare road leads back to the clean path; on `device`.
        device: the torch device on which pictures are made.

    Raises:
        RecordingError: the recordings cannot be driven in.
        ControllerError: the teacher raises, or answers wrongly.
    """

    def __init__(self, recordings: RecordingSet, teacher: Controller, *, device: torch.device | str = "cpu") -> None:
        self.world = RecordedWorld(recordings, device=device)
        self.world.fit(teacher)
        self._poses = torch.empty(0, 4, dtype=torch.float64, device=self.world.device)
        self._covers = torch.empty(0)

    def add_ways(self, driver: Controller, patterns: Pattern) -> None:
        """Drive over the bare road and over each pattern of a batch; later poses are drawn from these drives too.

        Raises:
            ControllerError: the driver raises, or answers wrongly.
        """
        canvas = self.world.bank.canvas
        with torch.no_grad():
            for pattern in (None, patterns):
                rolled = self.world.roll(driver, pattern)
                way = (rolled.x_m - canvas.x_m, rolled.y_m - canvas.y_m, rolled.yaw_rad, rolled.speed_mps)
                poses = torch.stack([column.flatten() for column in way], 1)
                parts = cast("tuple[Tensor, ...]", poses[:, :3].split(128))
                covers = [self.world.covered(Poses(*part.unbind(1))) for part in parts]
                self._poses, self._covers = torch.cat([self._poses, poses]), torch.cat([self._covers, *covers])

    def draw(self, count: int, generator: torch.Generator, *, to_paint: bool = True) -> Views:
        """Draw so many pictures, or a few less: poses far from every recorded one are left out.

        The more of a picture the canvas covers, the more often it is painted: there paint has most to say.

        Args:
            count: how many pictures to draw, at least 1.
            generator: where the randomness comes from, on the CPU.
            to_paint: False for pictures without a canvas.
        """
        weights = self._covers + LEAST_COVER if to_paint else torch.ones(len(self._poses))
        number = torch.multinomial(weights, count, replacement=True, generator=generator)
        chosen = self._poses[number.to(self._poses.device)]
        spread = torch.tensor([MOVED_M, TURNED_RAD, FASTER_MPS], dtype=torch.float64)
        noise = torch.randn(count, 3, generator=generator, dtype=torch.float64) * spread
        right, turned, faster = noise.to(chosen).unbind(1)
        x, y, yaw, speed = chosen.unbind(1)
        moved = Poses(x + torch.sin(yaw) * right, y - torch.cos(yaw) * right, yaw + turned)
        gap = self.world.bank.nearest(moved)
        parts = [gap.ahead_m / AHEAD_M, gap.left_m / LEFT_M, gap.turned_rad / TURN_RAD]
        far = torch.stack(parts).abs().amax(0)
        kept = (far <= far.min().clamp_min(1.0)).nonzero()[:, 0]
        moved, gap = moved.picked(kept), type(gap)(*(column[kept] for column in gap))
        with torch.no_grad():
            shown = self.world.bank.show(moved, gap, to_paint=to_paint)
        speed_mps = (speed + faster).clamp_min(0.0)[kept].float()
        command = self.world.bank.command[gap.frame]
        return Views(shown.frames, speed_mps, command, self.world.course.locate(moved), shown.canvas)

    def returning(self, place: Place, answer: Float[Tensor, " b"]) -> Float[Tensor, " b"]:
        """The teacher's steering, and where a car is far aside more and more of its law on the bare road.

        Up to 1 m aside the teacher's answer to the picture stands; from 2 m on its law, fitted to its answers to
        recorded pictures and taken no further aside than those go.
        """
        law = self.world.course.law(place._replace(right_m=place.right_m.clamp(-RECORDED_M, RECORDED_M)))
        return torch.lerp(answer, law.to(answer), (place.right_m.abs() - 1.0).clamp(0.0, 1.0).to(answer))

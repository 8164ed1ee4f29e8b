"""What an attack drives up: how far a painted pattern shifts a controller's steering on recorded drives.

The divergence δ of the paper compares the controller's answers to composited frames with its answers to the clean
ones. Signed for a group of drives (clean and right: to the right is positive; clean and left: to the
left), or the absolute value of each drive's sum where all drives are pooled.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from enum import StrEnum
from typing import cast

import torch
from jaxtyping import Float
from torch import Tensor

from roadproof.errors import RecordingError
from roadproof.recordings import Recording, RecordingSet, Side


class Direction(StrEnum):
    """Where an attack steers: to one side, or to whichever side each drive gives way."""

    RIGHT = "right"
    LEFT = "left"
    EITHER = "either"


@dataclass(frozen=True, slots=True)
class Group:
    """Drives that are attacked together, and the side the attack steers to.

    Args:
        sides: sides of the drives that belong to the group; empty for drives in a simulator.
        direction: "right" or "left" for the paper's Group, "either" for Group-All, Random and a single drive.
    """

    sides: tuple[Side, ...]
    direction: Direction

    def __str__(self) -> str:
        return "+".join(self.sides) if self.direction is not Direction.EITHER else "all"

    def select(self, recordings: RecordingSet) -> tuple[Recording, ...]:
        """The drives of a set that belong to this group.

        Raises:
            RecordingError: the set lacks a kind of drive that the group names.
        """
        have = {recording.side for recording in recordings.recordings}
        missing = [side for side in self.sides if side not in have]
        if missing:
            raise RecordingError(
                f"group {self} needs a {missing[0]} drive, the set has {', '.join(sorted(have))}; "
                "record one, or choose other groups"
            )
        return tuple(recording for recording in recordings.recordings if recording.side in self.sides)


RIGHT_GROUP = Group((Side.CLEAN, Side.RIGHT), Direction.RIGHT)
LEFT_GROUP = Group((Side.CLEAN, Side.LEFT), Direction.LEFT)


def parse_groups(text: str, recordings: RecordingSet) -> tuple[Group, ...]:
    """Groups from words: "clean+right,clean+left" (the paper's Group), or "all" (Group-All, Random, T = 1).

    Raises:
        RecordingError: a word is unknown, or a group names both sides or none.
    """
    if text == "all":
        sides = tuple(dict.fromkeys(recording.side for recording in recordings.recordings))
        return (Group(sides, Direction.EITHER),)
    return tuple(_parse_group(part) for part in text.split(","))


def _parse_group(text: str) -> Group:
    try:
        sides = tuple(Side(word.strip()) for word in text.split("+"))
    except ValueError:
        raise RecordingError(f"group {text!r} is unknown; write e.g. clean+right,clean+left or all") from None
    steered = [side for side in sides if side in (Side.LEFT, Side.RIGHT)]
    if len(steered) != 1 or Side.RANDOM in sides:
        raise RecordingError(f"group {text!r} needs exactly one of left and right, e.g. clean+right; or write all")
    return Group(sides, Direction(steered[0]))


def divergence(shift: Float[Tensor, "*b f"], lengths: Sequence[int], direction: Direction) -> Float[Tensor, "*b"]:
    """δ, per frame: how far steering moved where the attack wants it.

    Args:
        shift: steer on composited minus steer on clean frames, one drive of the group after another, (*b, F).
        lengths: number of frames of each drive; they sum to F.
        direction: "right" counts right as positive, "left" counts left; "either" takes the absolute sum of each drive.

    Returns:
        The sum over frames divided by their number, so that groups of different length compare; the paper's loss is
        its negative times the number of frames (and 180/π in the released code).

    References:
        Eq. tloss and the paragraph below it.
    """
    match direction:
        case Direction.RIGHT:
            total = shift.sum(-1)
        case Direction.LEFT:
            total = -shift.sum(-1)
        case Direction.EITHER:
            drives = cast("tuple[Tensor, ...]", shift.split(list(lengths), -1))
            total = torch.stack([drive.sum(-1).abs() for drive in drives]).sum(0)
    return total / shift.shape[-1]

"""Groups of recorded drives that are attacked together, each in a direction, and the divergence of such a group.

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
from roadproof.io.records import plain
from roadproof.recordings import Recording, RecordingSet, Side

Points = Float[Tensor, "g r k n"]
"""R points of a search space for each of G groups: K figures of N parameters each, in the unit cube."""

Values = Float[Tensor, "g r"]
"""A value of each of R points, for each of G groups."""


class Direction(StrEnum):
    """Where an attack takes the car: to one side, to less or more speed, or to whichever of two gives way."""

    RIGHT = "right"
    LEFT = "left"
    SLOWER = "slower"
    FASTER = "faster"
    EITHER = "either"


STEERED = (Direction.RIGHT, Direction.LEFT, Direction.EITHER)
"""The directions of an attack on steering and on the path."""

SPEEDS = (Direction.SLOWER, Direction.FASTER, Direction.EITHER)
"""The directions of an attack on the speed."""


@dataclass(frozen=True, slots=True)
class Group:
    """Drives that are attacked together, and where the attack takes the car.

    Args:
        sides: sides of the drives that belong to the group; empty for drives in a simulator.
        direction: "right" or "left" for the paper's Group, "either" for Group-All, Random and a single drive; "slower"
            or "faster" for an attack on the speed.
    """

    sides: tuple[Side, ...]
    direction: Direction

    def __str__(self) -> str:
        if self.direction is Direction.EITHER:
            return "all"
        return str(self.direction) if self.direction in SPEEDS else "+".join(self.sides)

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

    "slower,faster", or one of them, are those of an attack on the speed; all drives belong to each.

    Raises:
        RecordingError: a word is unknown, or a group names both sides or none.
    """
    sides = tuple(dict.fromkeys(recording.side for recording in recordings.recordings))
    if text == "all":
        return (Group(sides, Direction.EITHER),)
    speeds = {"slower": Group(sides, Direction.SLOWER), "faster": Group(sides, Direction.FASTER)}
    return tuple(speeds.get(part.strip()) or _parse_group(part) for part in text.split(","))


def known_as(group: Group, recordings: RecordingSet) -> object:
    """What tells a group of a set's drives from others: its name, or all of it where another may have that name."""
    try:
        (named,) = parse_groups(str(group), recordings)
    except RecordingError:
        return plain(group)
    # Of a speed only the direction counts.
    return str(group) if named == group or str(group) == group.direction else plain(group)


def require_names(groups: Sequence[Group]) -> None:
    """Refuse groups of which two have one name, since results know them by it.

    Raises:
        RecordingError: two groups have one name.
    """
    names = list(map(str, groups))
    if len({*names}) < len(names):
        raise RecordingError(f"groups are {', '.join(names)}, expected each name once; attack one after another")


def require_directions(groups: Sequence[Group], allowed: Sequence[Direction], objective: str) -> None:
    """Refuse groups that an objective cannot take the car to.

    Args:
        groups: the groups that are to be attacked.
        allowed: the directions that the objective knows.
        objective: name of the objective in words.

    Raises:
        RecordingError: a group has another direction; the message names it.
    """
    for group in groups:
        if group.direction not in allowed:
            others = "slower, faster" if allowed is SPEEDS else "clean+right, clean+left"
            raise RecordingError(f"the {objective} knows no group {group}; expected {others} or all")


def to_side(values: Float[Tensor, "*b"], direction: Direction) -> Float[Tensor, "*b"]:
    """Values that are positive to the right, or where the car is faster, as positive to a direction.

    Args:
        values: signed values, (*b).
        direction: the direction that counts as positive; "either" takes the absolute value of each.
    """
    if direction is Direction.EITHER:
        return values.abs()
    return values if direction in (Direction.RIGHT, Direction.FASTER) else -values


def _parse_group(text: str) -> Group:
    try:
        sides = tuple(Side(word.strip()) for word in text.split("+"))
    except ValueError:
        raise RecordingError(
            f"group {text!r} is unknown; write e.g. clean+right,clean+left or all, and for a speed slower,faster"
        ) from None
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
    if direction is Direction.EITHER:
        drives = cast("tuple[Tensor, ...]", shift.split(list(lengths), -1))
        total = torch.stack([drive.sum(-1).abs() for drive in drives]).sum(0)
    else:
        total = to_side(shift.sum(-1), direction)
    return total / shift.shape[-1]

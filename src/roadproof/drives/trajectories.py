"""Which drives are recorded, how the perturbed ones differ from the clean one, and which of their frames are kept."""

from __future__ import annotations

from dataclasses import dataclass, field
from enum import StrEnum
from itertools import cycle, islice

from roadproof.errors import RecordingError
from roadproof.recordings import Side

COUNTS = (1, 3, 5, 7)


class Scheme(StrEnum):
    """The paper's ways to choose perturbed drives."""

    GROUP = "group"
    RANDOM = "random"


@dataclass(frozen=True, slots=True)
class Swerve:
    """Leave the clean path to the side, by metres.

    The car is steered along the clean path with a smooth offset that begins when the canvas comes into view and has its
    full size over the canvas; a seed sets where it begins and ends to rise. How strong a pattern transfers depends on
    this size more than on how many drives there are.

    Args:
        swerves_m: sizes of the swerves, metres; the pairs of a Group (or the drives of Random) take them in turn.
        weaves_m: sizes of further drives, metres, that weave from side to side, so that frames show what a car sees
            that has turned, as an attacked one has.

    Raises:
        RecordingError: there is no size, or a size is outside 0.1…5 m.
    """

    swerves_m: tuple[float, ...] = (1.5,)
    weaves_m: tuple[float, ...] = ()

    def __post_init__(self) -> None:
        sizes = self.swerves_m + self.weaves_m
        if not sizes or not all(0.1 <= size <= 5.0 for size in sizes):
            raise RecordingError(f"swerves are {sizes} m, expected one or more between 0.1 and 5")


@dataclass(frozen=True, slots=True)
class SteeringNoise:
    """The published perturbation: the clean drive's controls given again, with whole degrees added to the steering.

    As in the released code, n° adds n·π/180 to a steer in [−1, 1], one draw a frame for 2.1 s, beginning 1.5 s before
    the canvas is out of view. Nothing steers back; how far the car goes astray depends on its speed.

    Args:
        low_deg: least noise to a side, whole degrees.
        high_deg: largest noise to a side, whole degrees.

    Raises:
        RecordingError: the range is not 0 ≤ low ≤ high ≤ 57, or it is only zero.

    References:
        getNoiseTrajs.sh of the released code.
    """

    low_deg: int = 4
    high_deg: int = 20

    def __post_init__(self) -> None:
        if not 0 <= self.low_deg <= self.high_deg <= 57 or self.high_deg == 0:
            raise RecordingError(
                f"steering noise is {self.low_deg}…{self.high_deg}°, expected 0 ≤ low ≤ high ≤ 57, high > 0"
            )


@dataclass(frozen=True, slots=True)
class DrivePlan:
    """The plan of one drive to be recorded.

    Args:
        name: name of the drive and of its folder.
        side: side to which the drive is perturbed.
        offset_m: largest offset of a swerve in metres; 0 for a clean drive and for steering noise.
        stream: number that tells its random draws from those of other drives.
        weaves: whether the drive weaves from side to side.
    """

    name: str
    side: Side
    offset_m: float
    stream: int
    weaves: bool = False


@dataclass(frozen=True, kw_only=True, slots=True)
class Trajectories:
    """How many drives are recorded, and how they are perturbed.

    Args:
        count: the paper's T, 1, 3, 5 or 7: the clean drive and T − 1 perturbed ones.
        scheme: "group" for pairs, one to the right and one to the left; "random" for both sides at random.
        perturbation: swerve by metres, or steering noise by degrees as published.

    Raises:
        RecordingError: T is not 1, 3, 5 or 7.
    """

    count: int = 3
    scheme: Scheme = Scheme.GROUP
    perturbation: Swerve | SteeringNoise = field(default_factory=Swerve)

    def __post_init__(self) -> None:
        if self.count not in COUNTS:
            raise RecordingError(f"T is {self.count} trajectories, expected one of {', '.join(map(str, COUNTS))}")

    def plans(self) -> tuple[DrivePlan, ...]:
        """The plans of all drives, the clean one first."""
        sides = (Side.RANDOM,) if self.scheme is Scheme.RANDOM else (Side.RIGHT, Side.LEFT)
        how, sizes = self.perturbation, [(0.0, False)]
        if isinstance(how, Swerve):
            sizes = [*((size, False) for size in how.swerves_m), *((size, True) for size in how.weaves_m)]
        perturbed = (
            DrivePlan(str(side) if k == 1 else f"{side}-{k}", side, size, k, weaves)
            for k, (size, weaves) in enumerate(cycle(sizes), 1)
            for side in sides
        )
        return (DrivePlan(str(Side.CLEAN), Side.CLEAN, 0.0, 0), *islice(perturbed, self.count - 1))


@dataclass(frozen=True, kw_only=True, slots=True)
class Window:
    """Which frames of a drive are kept.

    Args:
        horizon_m: largest distance before the canvas' near edge, metres.
        least_px: least number of pixels of the controller's input that show the canvas.
        frames: largest number of frames per drive, evenly spread.

    Raises:
        RecordingError: a field is not positive.
    """

    horizon_m: float = 25.0
    least_px: int = 60
    frames: int = 24

    def __post_init__(self) -> None:
        if not (self.horizon_m > 0 and self.least_px > 0 and self.frames > 0):
            raise RecordingError(
                f"the window is {self.horizon_m} m, {self.least_px} px, {self.frames} frames; expected all above 0"
            )

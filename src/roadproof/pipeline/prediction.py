"""What the recorded world predicted of a pattern, beside what the car did: both paths, and how far they are apart."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float

from roadproof.controllers import Controller
from roadproof.driving.deviation import passage, passage_deviation_m, path_of
from roadproof.driving.episode import Episode
from roadproof.driving.speed import speed_difference
from roadproof.errors import EpisodeError
from roadproof.io.records import RecordFile, Saved
from roadproof.patterns import Pattern
from roadproof.recorded.world import UNSURE, BiasedStart, RecordedWorld
from roadproof.recordings import RecordingSet


@dataclass(frozen=True, kw_only=True, slots=True, eq=False)
class Prediction(Saved):
    """The predicted drive over one pattern beside the real one.

    Args:
        predicted_m: the paper's deviation in the recorded world, metres, from the drive over the bare road there; mean
            over small errors.
        least_m: least predicted deviation over those errors, metres.
        most_m: largest predicted deviation over those errors, metres.
        driven_m: the paper's deviation of the drive in the simulator, metres.
        predicted_mps: mean change of the speed in the recorded world, m/s, negative where the car is slower, mean over
            small errors; None in files of earlier versions, as in the next three.
        least_mps: lowest predicted change over those errors, m/s.
        most_mps: highest predicted change over those errors, m/s.
        driven_mps: mean change of the speed of the drive in the simulator, m/s.
        made_of: digest of the pattern, drives, recordings and controller; empty where nobody said.
        path_error_m: mean distance between predicted and driven positions at the same instants, metres; None where the
            drive had ended before the canvas came into view.
        gap_m: largest distance of the predicted path across the heading from the recorded poses shown, metres.
        gap_rad: largest difference of heading from the recorded poses shown, radians.
        clean_xy: world x, y of the clean drive while the canvas is in view, metres, (t, 2).
        predicted_xy: world x, y of the predicted drive at the same instants, metres, (t, 2).
        driven_xy: world x, y of the drive over the pattern at those instants, metres, (u, 2).

    Raises:
        EpisodeError: there are some of the four speeds, and not all.
    """

    predicted_m: float
    least_m: float
    most_m: float
    driven_m: float
    path_error_m: float | None
    gap_m: float
    gap_rad: float
    clean_xy: Float[np.ndarray, "t 2"]
    predicted_xy: Float[np.ndarray, "t 2"]
    driven_xy: Float[np.ndarray, "u 2"]
    predicted_mps: float | None = None
    least_mps: float | None = None
    most_mps: float | None = None
    driven_mps: float | None = None
    made_of: str = ""

    def __post_init__(self) -> None:
        speeds = (self.predicted_mps, self.least_mps, self.most_mps, self.driven_mps)
        if len({speed is None for speed in speeds}) > 1:
            raise EpisodeError("the prediction has some of the four speeds, expected all or none")

    @property
    def error_m(self) -> float:
        """Predicted minus driven deviation."""
        return self.predicted_m - self.driven_m


Prediction.FILE = RecordFile(
    kind=Prediction,
    name="roadproof-prediction",
    version=2,
    error=EpisodeError,
    remedy="remove it to predict again",
)


def predict(
    recordings: RecordingSet,
    controller: Controller,
    pattern: Pattern,
    clean: Episode,
    painted: Episode,
    *,
    device: torch.device | str = "cpu",
) -> Prediction:
    """Drive over a pattern in the recorded world, and compare with a drive over it in the simulator.

    Args:
        recordings: recordings with canvas and tracks; the weather of the two drives must be the first of the set.
        controller: controller that drove, on `device`.
        pattern: the pattern that was driven over; one pattern, not a batch.
        clean: episode of the recorded drive over the bare road, in the simulator.
        painted: episode of the drive over the pattern, in the simulator.
        device: torch device on which the recorded world computes.

    Raises:
        RecordingError: the recordings lack a canvas or tracks, or no vehicle can be identified from them.
    """
    world = RecordedWorld(recordings.by_weather()[0], device=device)
    world.fit(controller)
    on_device = pattern[None].mapped(lambda part: part.to(device))
    with torch.no_grad():
        bare, rolled = (world.roll(controller, paint, starts=UNSURE) for paint in (None, on_device))
    found, usual = world.compared(bare, rolled), UNSURE.index(BiasedStart())
    deviations, changes = found.deviation_m, found.speed_change_mps
    predicted, canvas = world.whole_path(rolled, usual), world.course.canvas
    seen = passage(path_of(clean), canvas)
    driven = path_of(painted)[seen]
    both = min(len(driven), len(predicted))
    return Prediction(
        predicted_m=float(deviations.mean()),
        least_m=float(deviations.min()),
        most_m=float(deviations.max()),
        driven_m=passage_deviation_m(clean, painted, canvas),
        path_error_m=float(np.hypot(*(predicted[:both] - driven[:both]).T).mean()) if both else None,
        gap_m=float(rolled.left_m[usual].abs().max()),
        gap_rad=float(rolled.turned_rad[usual].abs().max()),
        clean_xy=path_of(clean)[seen],
        predicted_xy=predicted,
        driven_xy=driven,
        predicted_mps=float(changes.mean()),
        least_mps=float(changes.min()),
        most_mps=float(changes.max()),
        driven_mps=speed_difference(clean, painted, canvas).mean_mps,
    )

"""What the recorded world foretold of a pattern, beside what the car did: both paths, and how far they are apart."""

from __future__ import annotations

import json
import zipfile
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float

from roadproof.controllers import Controller
from roadproof.errors import EpisodeError
from roadproof.evaluation.result import passage_deviation_m, path_of
from roadproof.files import write_atomically
from roadproof.metrics import deviation_m, passage
from roadproof.patterns import Pattern
from roadproof.recorded.world import RecordedWorld
from roadproof.recordings import RecordingSet
from roadproof.rollout import Episode

FORMAT = "roadproof-prediction"
FORMAT_VERSION = 1
_PATHS = ("clean_xy", "predicted_xy", "driven_xy")


@dataclass(frozen=True, kw_only=True, slots=True, eq=False)
class Prediction:
    """One pattern, foretold and driven over.

    Args:
        predicted_m: the paper's deviation in the recorded world, against its own bare road.
        driven_m: the same in the simulator.
        path_error_m: mean distance between the predicted and the driven position at the same instants.
        gap_m: the most that the predicted path is aside of a recorded pose.
        gap_rad: the most that it is turned from one.
        clean_xy: world x, y of the clean drive while the canvas is in view.
        predicted_xy: of the predicted one.
        driven_xy: of the driven one.
    """

    predicted_m: float
    driven_m: float
    path_error_m: float
    gap_m: float
    gap_rad: float
    clean_xy: Float[np.ndarray, "t 2"]
    predicted_xy: Float[np.ndarray, "t 2"]
    driven_xy: Float[np.ndarray, "u 2"]

    @property
    def error_m(self) -> float:
        """Predicted minus driven deviation."""
        return self.predicted_m - self.driven_m

    def save(self, path: Path) -> None:
        """Write one NumPy archive with a JSON header.

        Raises:
            OutputError: it cannot be written.
        """
        header: dict[str, Any] = {"format": FORMAT, "version": FORMAT_VERSION}
        header |= {name: getattr(self, name) for name in self.__slots__ if name not in _PATHS}
        paths: dict[str, Any] = {name: getattr(self, name) for name in _PATHS}

        def write(part: Path) -> None:
            with part.open("wb") as file:
                np.savez_compressed(file, header=np.array(json.dumps(header)), **paths)

        write_atomically(path, write)

    @staticmethod
    def load(path: Path) -> Prediction:
        """Read what `save` wrote.

        Raises:
            EpisodeError: the file is missing, damaged or of another format.
        """
        try:
            with path.open("rb") as file, np.load(file, allow_pickle=False) as stored:
                header: dict[str, Any] = json.loads(str(stored["header"]))
                paths: dict[str, Any] = {name: np.asarray(stored[name], np.float64) for name in _PATHS}
            if (header.pop("format"), header.pop("version")) != (FORMAT, FORMAT_VERSION):
                raise ValueError("another format or version")
            return Prediction(**{name: float(value) for name, value in header.items()}, **paths)
        except (OSError, KeyError, TypeError, ValueError, zipfile.BadZipFile, EOFError) as error:
            raise EpisodeError(f"{path} is missing or damaged ({error}); remove it to predict again") from None


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
        recordings: with canvas and tracks.
        controller: on `device`; the one that drove.
        pattern: one pattern.
        clean: the simulator's drive over the bare road, the recorded one.
        painted: its drive over the pattern.
        device: where to predict.

    Raises:
        RecordingError: the set cannot be driven in.
    """
    world = RecordedWorld(recordings, device=device)
    world.fit(controller)
    on_device = Pattern(pattern.shapes, pattern.boxes[None].to(device), pattern.colours[None].to(device))
    with torch.no_grad():
        bare, rolled = world.roll(controller), world.roll(controller, on_device)
    predicted, canvas = world.whole_path(rolled, 0), world.course.canvas
    seen = passage(path_of(clean), canvas)
    driven = path_of(painted)[seen]
    both = min(len(driven), len(predicted))
    return Prediction(
        predicted_m=deviation_m(world.whole_path(bare, 0), predicted),
        driven_m=passage_deviation_m(clean, painted, canvas),
        path_error_m=float(np.hypot(*(predicted[:both] - driven[:both]).T).mean()) if both else 0.0,
        gap_m=float(rolled.left_m.abs().max()),
        gap_rad=float(rolled.turned_rad.abs().max()),
        clean_xy=path_of(clean)[seen],
        predicted_xy=predicted,
        driven_xy=driven,
    )

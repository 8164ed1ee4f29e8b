"""What the car's camera sees while it passes a pattern, once in each of a study's conditions."""

from __future__ import annotations

import io
from itertools import product
from pathlib import Path

import numpy as np
from jaxtyping import UInt8
from PIL import Image

from roadproof.driving.drive_store import load_episodes
from roadproof.driving.evaluation import Evaluation
from roadproof.driving.trial import Trial
from roadproof.pipeline.film import passage_steps, pictures_at
from roadproof.scenarios import Scenario
from roadproof.simulators.protocol import PatternImage, Simulator

PICTURES = 6
SIZE_PX = (240, 180)


def passages(simulator: Simulator, evaluation: Evaluation, folder: Path, paint: PatternImage) -> dict[str, bytes]:
    """Strips of camera pictures as JPEG files, by name: "passage-clear-noon.jpg", "passage-clear-noon-traffic.jpg".

    The first drive over the pattern in each weather, alone and in traffic, is driven again from its controls.

    Args:
        simulator: an open simulator of the kind that drove.
        evaluation: the evaluation with the drives that were judged.
        folder: the folder with the evaluation's episodes.
        paint: the canvas as it was painted.

    Raises:
        SimulatorError: as `rollout` raises it.
    """
    files: dict[str, bytes] = {}
    for weather, traffic in product(evaluation.weathers, (False, True)):
        for trial in evaluation.of(traffic=traffic, weather=weather)[:1]:
            strip = _strip(simulator, evaluation.scenario, trial, folder, paint)
            packed = io.BytesIO()
            Image.fromarray(strip).save(packed, format="JPEG", quality=88)
            files[file_of(weather, traffic=traffic)] = packed.getvalue()
    return files


def file_of(weather: str, *, traffic: bool) -> str:
    """The file of a condition's strip."""
    return f"passage-{weather}{'-traffic' if traffic else ''}.jpg"


def _strip(
    simulator: Simulator, scenario: Scenario, trial: Trial, folder: Path, paint: PatternImage
) -> UInt8[np.ndarray, "h w 3"]:
    clean, painted = load_episodes(folder, (trial.clean, trial.painted))
    steps = passage_steps(clean, painted, scenario.canvas, PICTURES)
    start = trial.start.of(scenario)
    return np.concatenate(list(pictures_at(simulator, painted, start, steps, SIZE_PX, pattern=paint)), 1)

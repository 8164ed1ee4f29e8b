"""What the car's camera sees of a pattern in every weather, from one place before it."""

from __future__ import annotations

import io
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from PIL import Image

from roadproof.datatypes import VehicleState, Weather
from roadproof.driving.episode import Episode
from roadproof.patterns import Pattern, raster
from roadproof.scenarios import Scenario
from roadproof.simulators.protocol import Simulator

BEFORE_M = 9.0
SIZE_PX = (400, 300)


def snapshots(
    simulator: Simulator, scenario: Scenario, pattern: Pattern, clean: Episode, weathers: Sequence[Weather]
) -> dict[str, bytes]:
    """Camera pictures of a pattern as JPEG files, by name: "view-clear-noon.jpg".

    Args:
        simulator: an open simulator.
        scenario: where.
        pattern: painted on its canvas.
        clean: a drive without it; the pictures are taken from its way, about 9 m before the canvas's middle.
        weathers: of the pictures.

    Raises:
        SimulatorError: as `reset` does.
    """
    there, paint = replace(scenario, start=_place(clean, scenario)), raster(pattern)
    files: dict[str, bytes] = {}
    for weather in weathers:
        seen = simulator.reset(there, weather=weather, pattern=paint, full_pictures=True)
        packed = io.BytesIO()
        Image.fromarray(seen.shown).resize(SIZE_PX, Image.Resampling.LANCZOS).save(packed, format="JPEG", quality=90)
        files[f"view-{weather}.jpg"] = packed.getvalue()
    return files


def _place(clean: Episode, scenario: Scenario) -> VehicleState:
    """Where the drive came so near."""
    away_m = np.hypot(clean.x_m - scenario.canvas.x_m, clean.y_m - scenario.canvas.y_m)
    coming = away_m[: int(away_m.argmin()) + 1]
    at = int(np.abs(coming - BEFORE_M).argmin())
    return clean.state(at)

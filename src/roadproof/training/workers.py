"""What a process drives with while many drives are recorded or scored."""

from __future__ import annotations

from collections.abc import Generator
from contextlib import contextmanager
from typing import NamedTuple

from roadproof.controllers import Controller, load_controller
from roadproof.simulators.town.simulator import TownSimulator


class Driving(NamedTuple):
    """An open simulator and the controller that drives; None for the expert."""

    town: TownSimulator
    controller: Controller | None


@contextmanager
def driving(spec: str | None, dt_s: float) -> Generator[Driving]:
    """Open the town, in steps of so many seconds, for the controller of a spec; None for the expert."""
    with TownSimulator(dt_s=dt_s) as town:
        yield Driving(town, None if spec is None else load_controller(spec))

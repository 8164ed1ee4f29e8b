"""What a process drives with while many drives are recorded or scored."""

from __future__ import annotations

from functools import cached_property

from roadproof.controllers import Controller, load_controller
from roadproof.simulators.town.simulator import TownSimulator


class Worker:
    """What a process drives with: a simulator and a controller, each made when first wanted and then kept.

    Args:
        controller_spec: spec of the controller; None for no controller.
        dt_s: seconds per step of the simulator.
    """

    def __init__(self, controller_spec: str | None, dt_s: float) -> None:
        self.controller_spec = controller_spec
        self.dt_s = dt_s

    @cached_property
    def town(self) -> TownSimulator:
        """An open simulator; it closes with its process, or in `close`."""
        return TownSimulator(dt_s=self.dt_s).__enter__()

    @cached_property
    def controller(self) -> Controller | None:
        """The controller, or None where there is none."""
        return None if self.controller_spec is None else load_controller(self.controller_spec)

    def close(self) -> None:
        """Close the simulator, if there is one."""
        if "town" in self.__dict__:
            self.town.__exit__(None, None, None)
            del self.town

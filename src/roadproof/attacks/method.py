"""What every method of searching has in common."""

from __future__ import annotations

from collections.abc import Sequence
from typing import ClassVar, Unpack

import torch

from roadproof.attacks.gradopt import Running, Search
from roadproof.attacks.groups import LEFT_GROUP, RIGHT_GROUP, Group, parse_groups
from roadproof.attacks.objective import Measure, Objective, RecordedMeasure
from roadproof.controllers import Controller
from roadproof.recordings import RecordingSet
from roadproof.search_space import SearchSpace


class Method:
    """A way to search the pattern of largest value; by gradient, where a kind does not say otherwise."""

    __slots__ = ()
    word: ClassVar[str]
    by_gradient: ClassVar[bool] = True

    def steps(self, objective: Objective) -> int:
        """How often `on_step` is called in a search for an objective."""
        raise NotImplementedError

    def groups(self, recordings: RecordingSet) -> tuple[Group, ...]:
        """Drives attacked together, where nothing else is said.

        By gradient the paper's two sides, each apart, where drives were pushed to both; else all drives.
        """
        return (RIGHT_GROUP, LEFT_GROUP) if recordings.has_both_sides else parse_groups("all", recordings)

    def measure(
        self,
        objective: Objective,
        recordings: RecordingSet,
        controller: Controller,
        groups: Sequence[Group],
        *,
        device: torch.device | str,
    ) -> RecordedMeasure:
        """What it makes large of an objective: the objective's own measure.

        Raises:
            RoadproofError: it does not know that objective.
        """
        return objective.measure(recordings, controller, groups, device=device)

    def check_space(self, space: SearchSpace) -> None:
        """See that it can search these patterns; called before any work begins.

        Raises:
            RoadproofError: it cannot; the message says what to change.
        """
        del space

    def search(self, measure: Measure, space: SearchSpace, objective: Objective, **running: Unpack[Running]) -> Search:
        """Make an objective's measure large for all of its groups."""
        raise NotImplementedError

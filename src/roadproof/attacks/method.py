"""What every method of searching has in common."""

from __future__ import annotations

from collections.abc import Sequence
from typing import ClassVar, Unpack

import torch

from roadproof.attacks.gradopt import Running, Search
from roadproof.attacks.groups import LEFT_GROUP, RIGHT_GROUP, Group, parse_groups
from roadproof.attacks.objective import Measure, Objective, RecordedMeasure, SpeedChange
from roadproof.controllers import Controller
from roadproof.recordings import RecordingSet
from roadproof.search_space import Family, SearchSpace


class Method:
    """A way to search for the pattern of largest value; it uses gradients unless a subclass says otherwise.

    `family` is where its figures lie where nothing else is said.
    """

    __slots__ = ()
    word: ClassVar[str]
    by_gradient: ClassVar[bool] = True
    family: ClassVar[Family] = "published"

    def steps(self, objective: Objective, /) -> int:
        """Number of the last step of a search for an objective."""
        raise NotImplementedError

    def groups(self, recordings: RecordingSet, objective: Objective | None = None) -> tuple[Group, ...]:
        """The groups of drives attacked together by default.

        With gradients the paper's two sides, each apart, if drives were perturbed to both, or slower and faster for a
        speed change; otherwise all drives, to whichever side each gives way.

        Args:
            recordings: the drives that are attacked.
            objective: what the search makes large; None for one of steering or of the path.
        """
        if self.by_gradient and isinstance(objective, SpeedChange):
            return parse_groups("slower,faster", recordings)
        sides = self.by_gradient and recordings.has_both_sides
        return (RIGHT_GROUP, LEFT_GROUP) if sides else parse_groups("all", recordings)

    def measure(
        self,
        objective: Objective,
        recordings: RecordingSet,
        controller: Controller,
        groups: Sequence[Group],
        *,
        device: torch.device | str,
    ) -> RecordedMeasure:
        """The measure that this method makes large for an objective; by default the objective's own.

        Raises:
            RoadproofError: the method cannot search for that objective.
        """
        return objective.measure(recordings, controller, groups, device=device)

    def check_space(self, space: SearchSpace) -> None:
        """Check that the method can search these patterns; called before any work begins.

        Raises:
            RoadproofError: the method cannot search these patterns; the message says what to change.
        """

    def search(self, measure: Measure, space: SearchSpace, **running: Unpack[Running]) -> Search:
        """Make an objective's measure large for all of its groups."""
        raise NotImplementedError

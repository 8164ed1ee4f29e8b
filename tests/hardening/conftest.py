"""A road whose pictures are known, ready to learn on."""

import pytest
import torch

from hardening_road import SPACE
from painted_ground import VEHICLE, RampFollower, recorded_road
from roadproof.hardening.views import Street
from roadproof.recorded import Vehicle


@pytest.fixture(scope="session")
def street():
    """The straight drives of the set say nothing of the steering, so that the vehicle is told."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Vehicle, "identified", staticmethod(lambda tracks: VEHICLE))
        made = Street(recorded_road(every=2), RampFollower())
    made.add_ways(RampFollower(), SPACE.pattern(SPACE.random((3,), torch.Generator().manual_seed(1))))
    return made

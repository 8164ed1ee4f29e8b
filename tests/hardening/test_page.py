"""The page of a hardening that is made by hand."""

import pytest

from browser import hindrances
from roadproof.hardening.judgement import Clean, Judged, Judgement
from roadproof.hardening.page import write_hardening
from roadproof.hardening.result import Hardened, Round
from roadproof.patterns import save_pattern
from roadproof.pipeline.stage_costs import StageCost
from runs import PATTERN


@pytest.mark.slow
def test_nothing_on_the_page_keeps_anybody_out(tmp_path):
    judged = [
        Judged(
            scenario="left-03",
            kind=kind,
            after=after,
            deviation_m=(metres, metres),
            left_lane=(metres > 1, False),
            simulator_calls=4,
        )
        for kind in ("by gradient", "random")
        for after, metres in ((False, 1.2), (True, 0.3))
    ]
    rounds = tuple(
        Round(number=number, deviation_m={"right-02": metres}, left_lane=metres / 2)
        for number, metres in ((0, 1.1), (1, 0.4))
    )
    clean = (Clean(4, 4, ()), Clean(4, 3, ("left-03, rainy-noon",)))
    found = Hardened(
        controller="pilotnet",
        hardened="hardened.safetensors",
        rounds=rounds,
        best=1,
        judgement=Judgement(tuple(judged), clean),
        cost={"learn": StageCost(90.0), "judge": StageCost(60.0, 16)},
    )
    for number in (0, 1):
        save_pattern(PATTERN, tmp_path / f"round-{number}" / "judged" / "left-03" / "pattern.json")
    assert hindrances(write_hardening(found, tmp_path)) == []

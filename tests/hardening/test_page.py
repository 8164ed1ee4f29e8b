"""The page of a hardening that is made by hand."""

from dataclasses import replace

import pytest

from browser import hindrances
from roadproof.hardening import Hardened
from roadproof.hardening.page import write_hardening
from roadproof.patterns import save_pattern
from runs import PATTERN, hardened


def test_a_street_that_could_not_be_judged_is_told_with_its_reason(tmp_path):
    found = hardened()
    before = tuple(each for each in found.judgement.judged if not each.after)
    found = replace(found, judgement=replace(found.judgement, judged=before, unjudged={"left-03": "it <stands>"}))
    save_pattern(PATTERN, tmp_path / "round-0" / "judged" / "left-03" / "pattern.json")
    page = write_hardening(found, tmp_path).read_text()
    assert "could not be judged on left-03: it &lt;stands&gt;." in page
    assert "no held-out street could be judged after it" in page
    found.save(tmp_path)
    assert Hardened.load(tmp_path) == found


@pytest.mark.slow
def test_nothing_on_the_page_keeps_anybody_out(tmp_path):
    found = hardened()
    for number in (0, 1):
        save_pattern(PATTERN, tmp_path / f"round-{number}" / "judged" / "left-03" / "pattern.json")
    assert hindrances(write_hardening(found, tmp_path)) == []

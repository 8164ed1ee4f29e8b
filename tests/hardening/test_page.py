"""The page of a hardening that is made by hand."""

import pytest

from browser import hindrances
from roadproof.hardening.page import write_hardening
from roadproof.patterns import save_pattern
from runs import PATTERN, hardened


@pytest.mark.slow
def test_nothing_on_the_page_keeps_anybody_out(tmp_path):
    found = hardened()
    for number in (0, 1):
        save_pattern(PATTERN, tmp_path / f"round-{number}" / "judged" / "left-03" / "pattern.json")
    assert hindrances(write_hardening(found, tmp_path)) == []

"""Replays without a GPU."""

import pytest

from roadproof.attacks import captured
from waiting import by_hand


@pytest.fixture
def replayed_on_the_cpu(monkeypatch):
    monkeypatch.setitem(captured.RECORDERS, "cpu", by_hand)

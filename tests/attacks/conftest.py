"""Replays without a GPU."""

import pytest

from roadproof.attacks import captured
from waiting import by_hand


@pytest.fixture(autouse=True)
def few_steps_are_recorded(monkeypatch):
    """The ladders of these tests are short."""
    monkeypatch.setattr(captured, "LEAST", 1)


@pytest.fixture
def replayed_on_the_cpu(monkeypatch):
    monkeypatch.setitem(captured.RECORDERS, "cpu", by_hand)

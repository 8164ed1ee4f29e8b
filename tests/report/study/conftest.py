import pytest

from hand_made_study import hand_made_records


@pytest.fixture
def records():
    return hand_made_records()

"""A network that is small enough for tests."""

import pytest

from roadproof.controllers import CIL


@pytest.fixture
def cil() -> CIL:
    return CIL(width=0.1, seed=5).eval()

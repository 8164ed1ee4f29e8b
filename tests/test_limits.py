from __future__ import annotations

import numpy as np
import pytest

from roadproof.errors import RoadproofError
from roadproof.limits import MAX_SEED, check_seed


@pytest.mark.parametrize("seed", [0, MAX_SEED, np.int64(3)])
def test_a_whole_number_is_a_seed(seed):
    check_seed(seed, "seed", RoadproofError)


@pytest.mark.parametrize("seed", [-1, MAX_SEED + 1, 1.0, float("nan"), True, "0", None])
def test_anything_else_is_none(seed):
    with pytest.raises(RoadproofError, match=f"seed is {seed!r}, expected a whole number from 0 to 4,294,967,295"):
        check_seed(seed, "seed", RoadproofError)

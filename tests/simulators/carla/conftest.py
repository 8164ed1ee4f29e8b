"""`roadproof carla serve` over a small map in a process of its own, for the tests of a module."""

import pytest

from carla_serving import serving


@pytest.fixture(scope="module")
def port(street):
    """Where it is served."""
    with serving("--map", street) as (_, opened):
        yield opened

"""A small map, and `roadproof carla serve` over it in a process of its own, for the tests of a module."""

import pytest

from carla_serving import serving, straight_map


@pytest.fixture(scope="module")
def street(tmp_path_factory):
    """The map's file."""
    return straight_map(tmp_path_factory.mktemp("maps"))


@pytest.fixture(scope="module")
def port(street):
    """Where it is served."""
    with serving("--map", street) as (_, opened):
        yield opened

import pytest

from carla_serving import straight_map


@pytest.fixture(scope="session")
def street(tmp_path_factory):
    """The file of a small map to serve."""
    return straight_map(tmp_path_factory.mktemp("maps"))

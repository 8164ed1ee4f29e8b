import pytest

from team_folder import write_team


@pytest.fixture(scope="module")
def team(tmp_path_factory):
    """A folder with a plan and all that it names."""
    folder = tmp_path_factory.mktemp("team")
    write_team(folder)
    return folder

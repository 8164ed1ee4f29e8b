"""What every test needs: shapes checked at run time, and the shared development data where it is at hand."""

import os
import signal
import sys
from pathlib import Path

import pytest

import needs
import type_checks

# Workers side by side have a core each; torch reads this when it is first imported.
if "PYTEST_XDIST_WORKER" in os.environ:
    os.environ.setdefault("OMP_NUM_THREADS", "1")

# Before any test imports roadproof.
type_checks.install()

DATA = Path(os.environ.get("ROADPROOF_DATA", Path(__file__).parents[2] / "shared" / "data"))


def _shared(name: str) -> Path:
    folder = DATA / name
    if not folder.is_dir():
        pytest.skip(f"development data {name} is not at {folder}; set ROADPROOF_DATA to the folder that holds it")
    return folder


@pytest.fixture(scope="session")
def carla_data() -> Path:
    """Real CARLA recordings of one left turn, with calibration."""
    return _shared("carla-left-70-63")


@pytest.fixture(scope="session")
def pilotnet_data() -> Path:
    """Weights and reference outputs of a PilotNet trained by others."""
    return _shared("pilotnet-udacity")


@pytest.fixture(scope="session")
def opendrive_data() -> Path:
    """CARLA's Town01 and Town02 as OpenDRIVE."""
    return _shared("opendrive")


@pytest.fixture(scope="session")
def town():
    """The town, opened once a worker: every reset makes it new."""
    needs.town()
    from roadproof.simulators.town.simulator import TownSimulator

    with TownSimulator() as simulator:
        yield simulator


@pytest.fixture
def few_pictures(monkeypatch):
    """Films and strips of few pictures: drawing them takes most of their time."""
    monkeypatch.setattr("roadproof.pipeline.film.PICTURE_S", 0.5)
    monkeypatch.setattr("roadproof.pipeline.film.MOMENTS", 7)


@pytest.fixture
def two_threads():
    """Threads of torch, whatever the tests have."""
    from roadproof.machine import threads

    with threads(2):
        yield


@pytest.fixture
def invoke(monkeypatch, capsys):
    """Calls the installed command, `roadproof WORDS`, in this process; gives exit code and output, `out` and `err`."""

    def call(*words):
        from roadproof.cli import main

        monkeypatch.setattr(sys, "argv", ["roadproof", *map(str, words)])
        with pytest.raises(SystemExit) as stopped:
            main()
        return stopped.value.code or 0, capsys.readouterr()

    return call


def pytest_runtest_setup() -> None:
    """Check the first calls of every function in this test, too, and let Ctrl-C raise its exception in it.

    A shell that runs the tests in the background has them ignore it, and a command that a test before called here in
    this process ends the processes beside it.
    """
    type_checks.begin_test()
    signal.signal(signal.SIGINT, signal.default_int_handler)


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Put files with slow tests first, so that workers end at the same time."""
    slow = {item.path for item in items if item.get_closest_marker("slow")}
    items.sort(key=lambda item: item.path not in slow)

"""Two workers in one folder: the second is told who is there; a killed one leaves nothing locked."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from roadproof.errors import OutputError
from roadproof.io.locks import hold, own_folder, working_in

CHILD = """
import sys, time
from pathlib import Path
from roadproof.io.locks import working_in
with working_in(Path(sys.argv[1])):
    print("in", flush=True)
    sys.stdin.readline()
"""


@pytest.fixture
def child(tmp_path):
    """Another process that works in a folder until it is told to end."""
    place = tmp_path / "run"
    command = [sys.executable, "-c", CHILD, str(place)]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        assert process.stdout.readline() == "in\n"
        yield process, place
        process.kill()


def test_the_second_is_told_who_works_there(child):
    process, place = child
    told = rf"-c .*\(process {process.pid}, since 20.*\) works in .*run; wait"
    with pytest.raises(OutputError, match=told), working_in(place):
        pass
    with pytest.raises(OutputError, match="works in"):
        hold(place)
    assert process.stdin is not None
    process.stdin.write("\n")
    process.stdin.close()
    process.wait()
    with working_in(place):
        pass
    assert not place.exists(), "nothing came of it"


def test_a_folder_stays_where_it_was_there_before_or_something_came_of_it(tmp_path):
    before, made = tmp_path / "before", tmp_path / "made"
    before.mkdir()
    with working_in(before), working_in(made):
        (made / "result").write_text("it")
    assert list(before.iterdir()) == []
    assert [path.name for path in made.iterdir()] == ["result"]


def test_a_killed_worker_leaves_the_folder_free(child):
    process, place = child
    os.kill(process.pid, signal.SIGKILL)
    process.wait()
    with working_in(place):
        pass


def test_one_process_can_ask_again(tmp_path: Path):
    with working_in(tmp_path), working_in(tmp_path / "." / "x" / ".."):
        pass
    with working_in(tmp_path):
        pass


def test_another_folder_is_another_matter(child, tmp_path):
    with working_in(tmp_path / "other"):
        pass


def test_a_folder_that_cannot_be_written_is_refused(tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(OutputError, match="cannot write"), working_in(tmp_path / "file" / "run"):
        pass


@pytest.mark.skipif(os.name != "posix", reason="links need rights elsewhere")
def test_a_link_is_no_folder_of_ones_own(tmp_path):
    own = own_folder(tmp_path, "locks")
    assert own_folder(tmp_path, "locks") == own
    own.rename(tmp_path / "elsewhere")
    own.symlink_to(tmp_path / "elsewhere")
    with pytest.raises(OutputError, match="is a link, expected a folder of yours"):
        own_folder(tmp_path, "locks")


def test_another_temporary_folder_is_no_way_round(child, tmp_path, monkeypatch):
    _, place = child
    monkeypatch.setenv("TMPDIR", str(tmp_path))
    monkeypatch.setattr("tempfile.tempdir", None)
    with pytest.raises(OutputError, match="works in"), working_in(place):
        pass


def test_one_may_go_to_another_directory_while_working(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    with working_in(Path("run")):
        monkeypatch.chdir("/")
    with working_in(tmp_path / "run"):
        pass


def test_a_folder_may_have_a_name_that_is_not_utf8(tmp_path):
    folder = tmp_path / os.fsdecode(b"out-\xff")
    with working_in(folder):
        assert folder.is_dir()

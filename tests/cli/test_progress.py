"""What long work says on the way: lines where no terminal looks, nothing with --quiet; and what it would take."""

import re
import time
from pathlib import Path

import pytest

from roadproof.cli import progress as saying
from roadproof.cli.progress import Loudness, duration_in_words, progress, speak, stages
from roadproof.cli.verbs import begin
from roadproof.errors import OutputError
from roadproof.pipeline.workload import Workload


@pytest.fixture(autouse=True)
def usual():
    yield
    speak(Loudness.USUAL)


def work(steps=4):
    with stages() as show:
        for stage in ("Recording", "Searching"):
            for done in range(steps + 1):
                show(stage, done, steps, "best 0.5" if done else "")


def test_a_log_has_a_line_where_a_stage_ends(capsys):
    work()
    assert capsys.readouterr().err.splitlines() == ["Recording 4/4 best 0.5", "Searching 4/4 best 0.5"]


def test_verbose_has_one_for_every_step_and_quiet_none(capsys):
    speak(Loudness.VERBOSE)
    work()
    assert len(capsys.readouterr().err.splitlines()) == 10
    speak(Loudness.QUIET)
    work()
    assert capsys.readouterr().err == ""


def test_silence_is_broken_with_the_time_left(capsys, monkeypatch):
    monkeypatch.setattr(saying, "EVERY_S", 0.7)
    with progress("Jobs", 10, "{:.0f} failed", begun=2) as show:
        show(4, 1.0)
        time.sleep(1.8)
    said = capsys.readouterr().err.splitlines()
    # Two of eight jobs took as long as this; those done before say nothing.
    assert re.fullmatch(r"Jobs 4/10 1 failed, [12] s, about [3-6] s left", said[-1])
    assert 1 <= len(said) <= 3


@pytest.mark.parametrize(("seconds", "words"), [(12.4, "12 s"), (600.0, "10 min"), (3 * 3600.0, "3.0 h")])
def test_times_are_said_as_people_do(seconds, words):
    assert duration_in_words(seconds) == words


def test_both_at_once_are_refused(invoke):
    code, printed = invoke("demo", "--quiet", "--verbose")
    assert code == 2
    assert printed.err == "roadproof: both --quiet and --verbose are given; choose one\n"


def test_a_dry_run_says_what_it_takes_and_writes_nothing(invoke, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    code, printed = invoke("demo", "--dry-run")
    assert (code, printed.err) == (0, "")
    # As README has them: 5 recorded, 10 replayed, 1 chosen, 16 to judge.
    assert printed.out.startswith("32 drives, about ")
    assert "MB on the disk" in printed.out
    assert list(tmp_path.iterdir()) == []


def test_what_takes_long_says_so_once_the_folder_is_its_own(capsys, tmp_path):
    long, short = (Workload(drives=3, seconds=seconds, megabytes=20.0) for seconds in (3600.0, 20.0))
    with pytest.raises(OutputError):
        begin(long, Path("/dev/null/x"))
    assert capsys.readouterr().err == ""
    begin(long, tmp_path)
    said = "This takes 3 drives, about 60 min, 20 MB on the disk; when it is interrupted, the same command goes on\n"
    assert capsys.readouterr().err == said
    begin(short, tmp_path)
    speak(Loudness.QUIET)
    begin(long, tmp_path)
    assert capsys.readouterr().err == ""

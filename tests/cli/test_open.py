"""The newest page of a folder is shown."""

import os
import shlex
import sys

import pytest

from command import roadproof


@pytest.fixture
def browser(tmp_path, monkeypatch):
    """A browser that only notes what it is asked to show."""
    seen = tmp_path / "seen.txt"
    note = f"import sys; open({str(seen)!r}, 'a').write(sys.argv[1])"
    monkeypatch.setenv("BROWSER", f"{shlex.quote(sys.executable)} -c {shlex.quote(note)} %s")
    return seen


def test_the_newest_page_is_opened(tmp_path, browser):
    old, new = tmp_path / "out" / "run" / "report.html", tmp_path / "out" / "compare.html"
    for age, page in enumerate((new, old)):
        page.parent.mkdir(parents=True, exist_ok=True)
        page.write_text("<!doctype html>")
        os.utime(page, (1_000_000 - age, 1_000_000 - age))
    done = roadproof("open", tmp_path / "out")
    assert done.stdout.strip() == str(new)
    assert browser.read_text() == new.as_uri()
    roadproof("open", old.parent)
    assert browser.read_text() == new.as_uri() + old.as_uri()


@pytest.mark.parametrize("folder", ["", "none"])
def test_a_folder_without_a_page_is_told(tmp_path, browser, folder):
    done = roadproof("open", tmp_path / folder)
    assert done.returncode == 2
    assert done.stderr.startswith(f"roadproof: {'no folder ' if folder else ''}{tmp_path}")
    assert not browser.exists()

"""The installed command, as `tests/cli` calls it."""

import sys

import pytest


@pytest.fixture
def invoke(monkeypatch, capsys):
    """Calls `roadproof WORDS`; gives its exit code and what it printed, `out` and `err`."""

    def call(*words):
        from roadproof.cli import main

        monkeypatch.setattr(sys, "argv", ["roadproof", *map(str, words)])
        with pytest.raises(SystemExit) as stopped:
            main()
        return stopped.value.code or 0, capsys.readouterr()

    return call

"""Commands are kept as they were given, and one that cannot be read is a clear line."""

import pytest

from roadproof.errors import RoadproofError
from roadproof.io.commands import FILE, read_commands, write_command


def test_a_command_is_kept_once_word_for_word(tmp_path):
    assert read_commands(tmp_path) == ()
    write_command(tmp_path, ["roadproof", "attack", "a b"])
    before = (tmp_path / FILE).stat().st_mtime_ns
    write_command(tmp_path, ["roadproof", "attack", "a b"])
    assert read_commands(tmp_path) == ("roadproof attack 'a b'",)
    assert (tmp_path / FILE).stat().st_mtime_ns == before
    write_command(tmp_path, ["roadproof", "demo"])
    assert read_commands(tmp_path) == ("roadproof demo",)


def test_a_file_that_is_no_text_is_named(tmp_path):
    (tmp_path / FILE).write_bytes(b"\xff\xfe\x00")
    with pytest.raises(RoadproofError, match=r"commands\.txt cannot be read .*; remove it"):
        read_commands(tmp_path)

"""The public names: all there, all typed, none forgotten."""

import ast
from pathlib import Path

import pytest

import roadproof


def typed_names():
    tree = ast.parse(Path(roadproof.__file__).read_text())
    return {alias.asname for node in ast.walk(tree) if isinstance(node, ast.ImportFrom) for alias in node.names} - {
        None
    }


def test_every_public_name_can_be_used_and_is_typed():
    names = set(dir(roadproof)) & typed_names()
    assert names == typed_names()
    for name in names:
        assert getattr(roadproof, name) is not None


def test_an_unknown_name_is_an_attribute_error():
    with pytest.raises(AttributeError, match="no attribute 'nothing'"):
        assert roadproof.nothing

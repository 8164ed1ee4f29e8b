"""Dataclasses in files: as JSON, or as an archive of arrays with a JSON header (.npz).

    FILE = RecordFile(Prediction, "roadproof-prediction", 2, EpisodeError, "remove it to predict again")
    FILE.write(path, prediction)
    prediction = FILE.read(path)

Convention:
    Every field is kept under its own name: an enum by its value, a dataclass as an object, a tuple as a list, None as
    null. A field annotated as an array is a member of the archive, or nested lists in JSON. What is read has the types
    that the dataclass declares, all the way down (floating point as float64, integers as int64), and no field that it
    does not declare but at the top; then its own `__post_init__` checks the values.
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping
from dataclasses import MISSING, dataclass, fields, is_dataclass
from functools import cache
from pathlib import Path
from typing import Any, Generic, TypeVar, cast, get_type_hints

import msgspec
import numpy as np
from jaxtyping import AbstractArray, Float, Int

from roadproof.errors import RoadproofError
from roadproof.io.arrays import HEADER, MOST_BYTES, read_record, write_archive
from roadproof.io.files import one_line, read_json, write_json

T = TypeVar("T")
_WRONG = (msgspec.ValidationError, OverflowError, RecursionError, RoadproofError, TypeError, UnicodeError, ValueError)


@dataclass(frozen=True, slots=True)
class RecordFile(Generic[T]):
    """How a dataclass is written to a file, and read from one that anyone may have made.

    Args:
        kind: the dataclass.
        name: the file's "format"; empty for an archive that names none.
        version: the "version" that is written, and the newest that is read.
        error: what is raised.
        remedy: what the user can do where a file is missing or damaged.
        elsewhere: fields that are not in this file; `read` takes them by name.
        header: name of an archive's JSON header; None where all its fields are arrays and numbers.
        most_bytes: that an archive may unpack to.
    """

    kind: type[T]
    name: str
    version: int
    error: type[RoadproofError]
    remedy: str
    elsewhere: tuple[str, ...] = ()
    header: str | None = HEADER
    most_bytes: int = MOST_BYTES

    def write(self, path: Path, value: T, **more: object) -> None:
        """Write a record, whole or not at all.

        Args:
            path: of a JSON file where it ends in .json, else of an archive.
            value: the record.
            **more: keys besides its fields, such as units, which are for people; or what is kept in place of a field.

        Raises:
            OutputError: the file cannot be written.
        """
        content: dict[str, Any] = {"format": self.name, "version": self.version} if self.name else {}
        content |= {name: plain(each) for name, each in more.items()}
        members = self._members(path)
        content |= {
            name: plain(getattr(value, name))
            for name in _types(self.kind)
            if name not in (*members, *more, *self.elsewhere)
        }
        if path.suffix == ".json":
            write_json(path, content)
            return
        header = {self.header: np.array(json.dumps(content, ensure_ascii=False))} if self.header else {}
        write_archive(path, header | {name: getattr(value, name) for name in members})

    def read(self, path: Path, **elsewhere: object) -> T:
        """Read a record.

        Args:
            path: of a JSON file where it ends in .json, else of an archive.
            **elsewhere: the fields that are not in the file.

        Raises:
            error: the file is missing, damaged, of another format or a newer version; a field is missing or of another
                type; or the dataclass refuses a value.
        """
        return self.made(path, self.content(path), **elsewhere)

    def content(self, path: Path) -> dict[str, Any]:
        """What a file holds: arrays as they are, all else as JSON has it; nothing of it is checked yet.

        Raises:
            error: the file is missing, damaged, of another format or a newer version.
        """
        if path.suffix == ".json":
            return read_json(path, self.name, self.version, self.error)
        stated, arrays = read_record(
            path,
            self._members(path),
            self.error,
            self.remedy,
            header=self.header,
            format_version=(self.name, self.version) if self.name else None,
            most_bytes=self.most_bytes,
        )
        return stated | arrays

    def made(self, path: Path, content: Mapping[str, Any], **elsewhere: object) -> T:
        """The record of what a file holds.

        Args:
            path: of the file, for messages.
            content: see `content`.
            **elsewhere: the fields that are not in it, or are to be taken in place of what it holds.

        Raises:
            error: a field is missing or of another type, or the dataclass refuses a value.
        """
        values = dict(elsewhere)
        try:
            for field in fields(cast("Any", self.kind)):
                if field.name in elsewhere:
                    continue
                if field.name in content:
                    values[field.name] = _typed(content[field.name], _types(self.kind)[field.name], field.name)
                elif field.default is MISSING and field.default_factory is MISSING:
                    raise ValueError(f"Object missing required field `{field.name}`")
            return self.kind(**values)
        except _WRONG as reason:
            raise self.error(f"{path} is incomplete or damaged ({one_line(reason)}); {self.remedy}") from None

    def _members(self, path: Path) -> tuple[str, ...]:
        """Fields that are arrays of the archive."""
        if path.suffix == ".json":
            return ()
        types = _types(self.kind).items()
        named = [name for name, kind in types if self.header is None or _is_array(kind)]
        return tuple(name for name in named if name not in self.elsewhere)


def plain(value: object) -> object:
    """A value as JSON has it: dataclasses as objects, enums by value, tuples and arrays as lists."""
    return msgspec.to_builtins(value, enc_hook=lambda numbers: numbers.tolist())  # NumPy's, the only others


def check_arrays(
    value: object, names: Iterable[str], shape: tuple[int, ...], of: str, error: type[RoadproofError]
) -> None:
    """See that arrays of a dataclass have one shape and finite values.

    Args:
        value: the dataclass.
        names: of the fields.
        shape: of each.
        of: what they belong to, for the message: "of the episode".
        error: what to raise.

    Raises:
        error: one has another shape, or NaN or infinite values.
    """
    for name in names:
        values: np.ndarray = getattr(value, name)
        if values.shape != shape:
            raise error(f"{name} {of} has shape {values.shape}, expected {shape}")
        if not np.isfinite(values).all():
            raise error(f"{name} {of} has NaN or infinite values")


@cache
def _types(kind: type) -> dict[str, Any]:
    hints = get_type_hints(kind)
    return {field.name: hints[field.name] for field in fields(kind)}


def _is_array(kind: object) -> bool:
    return isinstance(kind, type) and issubclass(kind, AbstractArray)


def _typed(stored: Any, kind: Any, name: str) -> object:  # noqa: ANN401
    """A field's value, from what a file holds of it.

    Raises:
        ValueError: it is of another type; says which.
    """
    if _is_array(kind):
        return _array(np.asarray(stored), kind, name)
    if isinstance(stored, np.ndarray):
        if stored.shape:
            raise ValueError(f"{name} of shape {stored.shape}, expected one number")
        stored = stored.item()
    try:
        made: object = msgspec.convert(stored, kind)
    except msgspec.ValidationError as reason:
        raise ValueError(f"{name}: {reason}") from None
    _refuse_unknown(stored, made, name)
    return made


def _array(values: np.ndarray, kind: Any, name: str) -> np.ndarray:  # noqa: ANN401
    if kind.dtype is Float and values.dtype.kind in "biuf":
        values = values.astype(np.float64, copy=False)
    elif kind.dtype is Int:
        if values.dtype.kind not in "iu":
            raise ValueError(f"{name} of type {values.dtype}, expected whole numbers")
        values = values.astype(np.int64, copy=False)
    if not isinstance(values, kind):
        raise ValueError(f"{name} is {values.dtype} of shape {values.shape}, expected {kind.__name__}")
    return values


def _refuse_unknown(stored: Any, made: Any, name: str) -> None:  # noqa: ANN401
    """A camera with a field that nobody reads would be another camera."""
    if isinstance(stored, dict) and is_dataclass(made):
        known = {field.name for field in fields(made)}
        for key, value in cast("dict[str, Any]", stored).items():
            if key not in known:
                raise ValueError(f"{name} has an unknown field {key!r:.60}")
            _refuse_unknown(value, getattr(made, key), f"{name}.{key}")
    elif isinstance(stored, list) and isinstance(made, (list, tuple)):
        for one, other in zip(cast("list[Any]", stored), cast("tuple[Any, ...]", made), strict=True):
            _refuse_unknown(one, other, name)

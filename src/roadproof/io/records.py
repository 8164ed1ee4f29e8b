"""Dataclasses in files: as JSON, or as an archive of arrays with a JSON header (.npz).

    FILE = RecordFile(kind=Report, name="roadproof-report", version=2, error=ReportError, remedy="make it again")
    FILE.write(path, report)
    report = FILE.read(path)

Convention:
    Every field is kept under its own name: an enum by its value, a dataclass as an object, a tuple as a list, None as
    null. A field annotated as an array is a member of the archive, or nested lists in JSON. What is read has the types
    that the dataclass declares, all the way down (floating point as float64, integers as int64), and no field that it
    does not declare but at the top; then its own `__post_init__` checks the values.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import MISSING, dataclass, field, fields
from pathlib import Path
from typing import Any, ClassVar, Generic, TypeVar, cast

import msgspec
import numpy as np
from jaxtyping import AbstractArray, Float, Int

from roadproof.errors import RoadproofError
from roadproof.io.arrays import HEADER, MOST_BYTES, read_record, write_archive
from roadproof.io.files import AnyPath, as_path, one_line, write_json
from roadproof.io.tables import declared_types, unknown_keys
from roadproof.io.text import MOST_TEXT_BYTES, read_json

T = TypeVar("T")
SavedT = TypeVar("SavedT", bound="Saved")
_WRONG = (KeyError, OverflowError, RecursionError, RoadproofError, TypeError, UnicodeError, ValueError)


@dataclass(frozen=True, slots=True)
class Form:
    """How a field is kept where a file has it in another form than the dataclass.

    Args:
        kind: the type of what the file holds.
        stated: makes what the file holds from the field's value.
        meant: makes the field's value from what the file holds; an error in it means that the file is damaged.
    """

    kind: Any
    stated: Callable[[Any], object]
    meant: Callable[[Any], object]


@dataclass(frozen=True, kw_only=True, slots=True)
class RecordFile(Generic[T]):
    """How a dataclass is written to a file, and read from one that anyone may have made.

    Args:
        kind: the dataclass that is written and read.
        name: the "format" that the file names; empty for an archive that names none.
        version: the "version" that is written, and the newest that is read.
        error: the type of error to raise.
        remedy: what the user can do where a file is missing or damaged.
        elsewhere: names of fields that are not in this file; `read` takes their values by name.
        forms: the forms of fields that the file has otherwise than the dataclass, by the field's name.
        notes: what the file says besides the fields, for people, such as units.
        header: name of an archive's JSON header; None where all its fields are arrays and numbers.
        most_bytes: how many bytes an archive may unpack to, and JSON may have (`MOST_TEXT_BYTES` at most).
        level: the compression level of an archive, 0 to 9; 1 where there is much data and time counts.
    """

    kind: type[T]
    name: str = ""
    version: int = 1
    error: type[RoadproofError]
    remedy: str
    elsewhere: tuple[str, ...] = ()
    forms: Mapping[str, Form] = field(default_factory=dict[str, Form])
    notes: Mapping[str, object] = field(default_factory=dict[str, object])
    header: str | None = HEADER
    most_bytes: int = MOST_BYTES
    level: int = 6

    def write(self, path: Path, value: T, **more: object) -> None:
        """Write a record, whole or not at all.

        Args:
            path: the file to write: JSON where its name ends in .json, else an archive.
            value: the record to write.
            **more: what the file says besides the record's fields and notes, by key.

        Raises:
            OutputError: the file cannot be written.
        """
        members = self._members(path)
        content = self.document(value, members, **more)
        if path.suffix == ".json":
            write_json(path, content)
            return
        arrays: dict[str, Any] = {name: getattr(value, name) for name in members}
        if self.header is not None:
            arrays[self.header] = np.array(json.dumps(content, ensure_ascii=False))
        write_archive(path, arrays, level=self.level)

    def document(self, value: T, members: Sequence[str] = (), **more: object) -> dict[str, Any]:
        """All that a JSON file says of a record: format and version, notes, what is said besides, and its fields."""
        content = {"format": self.name, "version": self.version} if self.name else {}
        return cast("dict[str, Any]", plain({**content, **self.notes, **more})) | self.stated(value, members)

    def stated(self, value: T, members: Sequence[str] = ()) -> dict[str, Any]:
        """A record's fields as JSON has them, but for those that are members of an archive."""
        names = [name for name in declared_types(self.kind) if name not in (*self.elsewhere, *members)]
        values: dict[str, object] = {name: getattr(value, name) for name in names}
        for name in self.forms.keys() & values.keys():
            values[name] = self.forms[name].stated(values[name])
        return cast("dict[str, Any]", plain(values))

    def read(self, path: Path, **elsewhere: object) -> T:
        """Read a record.

        Args:
            path: the file to read: JSON where its name ends in .json, else an archive.
            **elsewhere: the values of the fields that are not in the file.

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
            return read_json(
                path, self.name, self.version, self.error, most_bytes=min(self.most_bytes, MOST_TEXT_BYTES)
            )
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
        """The record in what `content` read from a file; `path`, `elsewhere` and the errors are those of `read`."""
        values = dict(elsewhere)
        try:
            for each in fields(cast("Any", self.kind)):
                name, form = each.name, self.forms.get(each.name)
                if name in elsewhere:
                    continue
                if name in content:
                    kind = declared_types(self.kind)[name] if form is None else form.kind
                    typed = _typed(content[name], kind, name)
                    values[name] = typed if form is None else form.meant(typed)
                elif each.default is MISSING and each.default_factory is MISSING:
                    raise ValueError(f"Object missing required field `{name}`")
            return self.kind(**values)
        except _WRONG as reason:
            raise self.error(f"{path} is incomplete or damaged ({one_line(reason)}); {self.remedy}") from None

    def _members(self, path: Path) -> tuple[str, ...]:
        """Fields that are arrays of the archive."""
        types = {} if path.suffix == ".json" else declared_types(self.kind)
        named = [name for name, kind in types.items() if self.header is None or _is_array(kind)]
        return tuple(name for name in named if name not in self.elsewhere)


class Saved:
    """What a dataclass with a file of its own can do."""

    __slots__ = ()
    FILE: ClassVar[RecordFile[Any]]

    def save(self, path: AnyPath) -> None:
        """Write the record to one file, all or nothing.

        Raises:
            OutputError: the file cannot be written.
        """
        path = as_path(path)
        self.FILE.write(path, self)

    @classmethod
    def load(cls: type[SavedT], path: AnyPath) -> SavedT:
        """Read what `save` wrote.

        Raises:
            RoadproofError: the file is missing, damaged, of another format or a newer version; of the kind that its
                values raise.
        """
        path = as_path(path)
        return cls.FILE.read(path)


def plain(value: object) -> object:
    """A value as JSON has it: dataclasses as objects, enums by value, tuples and arrays as lists."""
    return msgspec.to_builtins(value, enc_hook=lambda numbers: numbers.tolist())  # NumPy's, the only others


def check_arrays(
    value: object, names: Iterable[str], shape: tuple[int, ...], of: str, error: type[RoadproofError]
) -> None:
    """See that arrays of a dataclass have one shape and finite values.

    Args:
        value: the dataclass that holds the arrays.
        names: names of the fields that are checked.
        shape: the shape that each of them must have.
        of: what the arrays belong to, for the message, such as "of the episode".
        error: the type of error to raise.

    Raises:
        error: an array has another shape, or NaN or infinite values.
    """
    for name in names:
        values: np.ndarray = getattr(value, name)
        if values.shape != shape:
            raise error(f"{name} {of} has shape {values.shape}, expected {shape}")
        if not np.isfinite(values).all():
            raise error(f"{name} {of} has NaN or infinite values")


def _is_array(kind: object) -> bool:
    return isinstance(kind, type) and issubclass(kind, AbstractArray)


def _typed(stored: Any, kind: Any, name: str) -> object:  # noqa: ANN401
    """A field's value, from what a file holds of it; a `ValueError` says which field is of another type."""
    if _is_array(kind):
        return _array(np.asarray(stored), kind, name)
    if isinstance(stored, np.ndarray):
        if stored.shape:
            raise ValueError(f"{name} of shape {stored.shape}, expected one number")
        stored = cast("Any", stored).item()
    try:
        made: object = msgspec.convert(stored, kind)
    except msgspec.ValidationError as reason:
        raise ValueError(f"{name}: {reason}") from None
    for where, key, _ in unknown_keys(kind, stored, name):
        raise ValueError(f"{where} has an unknown field {key!r:.60}")
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

"""What a value, a function or an object is known by: more than its name, so that who edits it has another one."""

from __future__ import annotations

import dis
import inspect
import re
import sys
from collections.abc import Iterable, Mapping
from dataclasses import fields, is_dataclass
from enum import Enum
from functools import cache, partial
from pathlib import PurePath
from types import CodeType, FunctionType, MethodType, ModuleType
from typing import Any, NamedTuple, cast

import numpy as np

from roadproof.io.identity import digest, stated

_DEEPEST = 8
_CHANGING = (list, dict, set, bytearray)
"""What a function's surroundings may hold as a memory of its calls: it is told as it was when first asked for."""
_NOT_THE_USERS = sys.stdlib_module_names | {"torch", "numpy", __name__.partition(".")[0]}


def without_addresses(text: str) -> str:
    """A repr without the places in memory that it names, which are others in every process."""
    return re.sub(r" at 0x[0-9a-fA-F]+", "", text)


class _Within(NamedTuple):
    """The ids of what lies around a value, and of the functions and classes that were told before it."""

    above: tuple[int, ...]
    told: set[int]


def known_by(thing: object) -> Any:  # noqa: ANN401
    """What tells a value, an object or a function from others, in any process: as JSON has it.

    A function is known by its name and source, and by what it was given: defaults, the arguments of a partial one, and
    what it uses of the user's modules and of its closure; lists, dicts and sets, which may grow as it is called, count
    as they were when this process was first asked. An object is known by its class with its source, and by what its
    constructor takes, where it keeps that under the same name; a dataclass by its fields; a network by its weights too.
    Roadproof's own functions and classes have no source here: their version and their answers tell, and what a network
    of theirs keeps as its `identity`. A path tells nothing, as a folder may be moved.
    """
    return _known(thing, _Within((), set()))


def plain_fields(thing: object) -> dict[str, Any]:
    """The numbers, texts and arrays that an object keeps, by name, as `known_by` has them."""
    usual = _kept(_torch().nn.Module()) if _is_module(thing) else {}
    kept = {name: value for name, value in _kept(thing).items() if name not in usual}
    return {name: known_by(value) for name, value in kept.items() if _is_plain(value)}


def _known(thing: Any, within: _Within) -> Any:  # noqa: ANN401
    if thing is None or isinstance(thing, bool | int | float | str):
        return thing.value if isinstance(thing, Enum) else thing
    if id(thing) in within.above or len(within.above) > _DEEPEST:
        return type(thing).__name__
    if isinstance(thing, FunctionType | type):
        if id(thing) in within.told:
            return _name(thing)
        within.told.add(id(thing))
    within = _Within((*within.above, id(thing)), within.told)
    if isinstance(thing, PurePath):
        return "a path"
    if isinstance(thing, Enum):
        return thing.name
    if isinstance(thing, bytes | bytearray):
        return digest(thing)
    if isinstance(thing, np.ndarray | np.generic) or _is_tensor(thing):
        return _array(thing)
    if isinstance(thing, Mapping):
        return {str(key): _known(value, within) for key, value in cast("Mapping[object, object]", thing).items()}
    if isinstance(thing, list | tuple):
        return [_known(each, within) for each in cast("list[object]", thing)]
    if isinstance(thing, set | frozenset):
        return sorted(stated(_known(each, within)) for each in cast("set[object]", thing))
    if isinstance(thing, partial):
        return {"partial": [_known(each, within) for each in (thing.func, thing.args, thing.keywords)]}
    if isinstance(thing, MethodType):
        return {"method": [_known(each, within) for each in (thing.__func__, thing.__self__)]}
    if isinstance(thing, FunctionType):
        return _function(thing, within)
    if isinstance(thing, type):
        return _class(thing, within)
    return _object(thing, within)


def _function(function: FunctionType, within: _Within) -> dict[str, Any]:
    told: dict[str, Any] = {"function": _label(function)}
    if _is_ours(function):
        function = inspect.unwrap(function)
        told["uses"] = _uses(function, within, {})
    else:
        given: list[object] = [*(function.__defaults__ or ()), *(function.__kwdefaults__ or {}).items()]
        told |= {"source": _source(function), "given": [_known(each, within) for each in given]}
        told["uses"] = _uses(function, within, function.__globals__)
    return {name: value for name, value in told.items() if value}


def _uses(function: FunctionType, within: _Within, around: Mapping[str, object]) -> dict[str, Any]:
    """The constants and functions around a function, and in its closure, that it names and does not set."""
    code = function.__code__
    read, written = _names(code)
    found = {name: around[name] for name in read if name in around}
    for module, its in [(name, value) for name, value in found.items() if isinstance(value, ModuleType)]:
        if _is_the_users(its.__name__):
            found |= {f"{module}.{name}": vars(its)[name] for name in read if name in vars(its)}
    for name, cell in zip(code.co_freevars, function.__closure__ or (), strict=True):
        try:
            found[name] = cell.cell_contents
        except ValueError:  # not set yet
            continue
    told: dict[str, Any] = {}
    for name, value in sorted(found.items()):
        if name in written or name.startswith("__") or isinstance(value, ModuleType):
            continue
        if isinstance(value, _CHANGING):
            told[name] = _as_first_seen(cast("object", value), within)
            continue
        foreign = isinstance(value, FunctionType | type) and not _is_the_users(value.__module__)
        told[name] = _name(cast("type", value)) if foreign else _known(value, within)
    return told


_first_seen: dict[int, tuple[object, Any]] = {}


def _as_first_seen(value: object, within: _Within) -> Any:  # noqa: ANN401
    """What was known of a list or dict when it was first asked for; it is kept, so that its id stays its own."""
    if id(value) not in _first_seen:
        _first_seen[id(value)] = (value, _known(value, within))
    return _first_seen[id(value)][1]


def _names(code: CodeType) -> tuple[set[str], set[str]]:
    """The names that code reads from around it, and those that it sets there."""
    read = set(code.co_names)
    stores = ("STORE_GLOBAL", "STORE_DEREF", "DELETE_GLOBAL")
    written = {str(each.argval) for each in dis.get_instructions(code) if each.opname in stores}
    for inner in code.co_consts:
        if isinstance(inner, CodeType):
            more = _names(inner)
            read, written = read | more[0], written | more[1]
    return read, written


def _class(kind: type, within: _Within) -> dict[str, Any]:
    """A class with those that it inherits from in its package, each with what its methods use."""
    package, told = str(kind.__module__).partition(".")[0], dict[str, Any]()
    if _is_ours(kind) or package in _NOT_THE_USERS:
        return {"class": _name(kind)}
    for each in kind.__mro__:
        if str(each.__module__).partition(".")[0] == package or _is_the_users(each.__module__):
            methods = [method for value in vars(each).values() for method in _methods(value)]
            uses = {
                name: value for method in methods for name, value in _uses(method, within, method.__globals__).items()
            }
            told[_label(each)] = [_source(each), uses]
    return {"class": _label(kind), "source": told}


def _methods(member: Any) -> list[FunctionType]:  # noqa: ANN401
    """The functions of a class's member: of a method itself, of a property up to three."""
    names = ("__func__", "fget", "fset", "fdel", "func")
    found = [member, *(getattr(member, name, None) for name in names)]
    return [each for each in found if isinstance(each, FunctionType)]


def _object(thing: Any, within: _Within, *, weights: bool = True) -> dict[str, Any]:  # noqa: ANN401
    kind = cast("type[Any]", type(thing))
    told: dict[str, Any] = _class(kind, within)
    kept = _kept(thing)
    if is_dataclass(kind):
        told["fields"] = {each.name: _known(getattr(thing, each.name, None), within) for each in fields(kind)}
    else:
        try:
            names = list(inspect.signature(kind).parameters)
        except (TypeError, ValueError):
            names = []
        settings = {name: kept.get(name, kept.get(f"_{name}")) for name in names}
        told["fields"] = {name: _known(value, within) for name, value in settings.items() if value is not None}
    if _is_module(thing):
        if _is_ours(kind) and "identity" in kept:
            told["identity"] = kept["identity"]
        children = cast("Iterable[tuple[str, object]]", thing.named_children())
        told["modules"] = {name: _object(each, within, weights=False) for name, each in children}
        if weights:
            told["weights"] = _known(thing.state_dict(), within)
    return told


def _kept(thing: object) -> dict[str, object]:
    return getattr(thing, "__dict__", {})


def _is_plain(value: object) -> bool:
    if isinstance(value, tuple):
        return all(map(_is_plain, cast("tuple[object, ...]", value)))
    return isinstance(value, bool | int | float | str | np.ndarray | np.generic) or _is_tensor(value)


def _array(values: Any) -> list[Any]:  # noqa: ANN401
    """The type, shape and content of an array or tensor, wherever its memory lies."""
    if _is_tensor(values):
        try:
            values = values.detach().cpu()
            content = values.contiguous().flatten().view(_torch().uint8).numpy()
        except (RuntimeError, TypeError, NotImplementedError):  # sparse, or without memory
            content = str(values)
    else:
        values = np.asarray(values)
        content = repr(values) if values.dtype == object else values
    return [str(values.dtype), list(values.shape), digest(content)]


def _torch() -> Any:  # noqa: ANN401
    """Torch, where it was imported: who has none has no tensors."""
    return sys.modules.get("torch")


def _is_tensor(value: object) -> bool:
    return _torch() is not None and isinstance(value, _torch().Tensor)


def _is_module(value: object) -> bool:
    return _torch() is not None and isinstance(value, _torch().nn.Module)


def _name(thing: FunctionType | type) -> str:
    return f"{thing.__module__}:{thing.__qualname__}"


def _label(thing: FunctionType | type) -> str:
    """The name without the module where the source tells: run as a script, it is another module."""
    return _name(thing) if _is_ours(thing) or not _source(thing) else thing.__qualname__


@cache
def _is_the_users(module: str | None) -> bool:
    """Whether a module is one that its user may edit: not ours, not Python's, not installed."""
    if not module:
        return False
    file = getattr(sys.modules.get(module), "__file__", None) or ""
    return module.partition(".")[0] not in _NOT_THE_USERS and "-packages" not in file


def _is_ours(thing: FunctionType | type) -> bool:
    return str(thing.__module__).partition(".")[0] == __name__.partition(".")[0]


@cache
def _source(thing: FunctionType | type) -> str:
    """The digest of a source as it was when it was first asked for; where a function has none, that of its code."""
    try:
        return digest(inspect.getsource(thing))[:16]
    except (OSError, TypeError):
        return digest(stated(_compiled(thing.__code__)))[:16] if isinstance(thing, FunctionType) else ""


def _compiled(code: CodeType) -> list[Any]:
    """What a function does, where only its code is there."""
    held = [_compiled(each) if isinstance(each, CodeType) else known_by(each) for each in code.co_consts]
    return [code.co_code.hex(), list(code.co_names), held]

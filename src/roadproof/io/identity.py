"""What a folder was made of: named parts, kept with what was made, so that one thing is never taken for another."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from pathlib import Path
from typing import cast

import numpy as np

from roadproof.errors import RoadproofError

ANSWERS = "answers"
"""The part that says how the controller answered (`controllers.identity`), whatever it is called."""

CONTROLLER = "controller_digest"
"""The part that says which controller it was: its weights, settings, source and all answers."""

_ANOTHER = {
    ANSWERS: "which answers otherwise, as before a training",
    CONTROLLER: "whose weights, settings or source are others",
}
_MOST_CHARACTERS = 60


def stated(parts: object) -> str:
    """Parts as one text, the same for the same parts."""
    return json.dumps(parts, sort_keys=True, default=str)


def digest(*contents: str | bytes | bytearray | np.ndarray) -> str:
    """SHA-256 of texts, bytes and the bytes of arrays, one after another; 64 hexadecimal digits."""
    found = hashlib.sha256()
    for content in contents:
        if isinstance(content, np.ndarray):
            found.update(np.ascontiguousarray(content).tobytes())
        else:
            found.update(content.encode() if isinstance(content, str) else content)
    return found.hexdigest()


def require_same(
    folder: Path, what: str, before: object, now: Mapping[str, object], error: type[RoadproofError]
) -> None:
    """Refuse to go on in a folder where something of other parts was begun.

    Args:
        folder: the folder in which something was begun.
        what: what the folder holds, for the message, such as "a run".
        before: the parts that were kept there, as JSON has them.
        now: the parts of what is to be done in the folder.
        error: the type of error to raise.

    Raises:
        error: a part of `now` was not kept there or differs; the message names the first, with what it was and what
            it is.
    """
    known = cast("dict[str, object]", before) if isinstance(before, dict) else {}
    for part, value in cast("dict[str, object]", json.loads(json.dumps(now, default=str))).items():
        if part in known and known[part] == value:
            continue
        if not known:
            differs = "that does not say what it was made of"
        elif part not in known:
            differs = f"that does not say its {'controller' if part in _ANOTHER else part}"
        elif part in _ANOTHER:
            differs = f"of another controller, {_ANOTHER[part]}"
        else:
            differs = "with {} {}, now it is {}".format(*_first_difference(part, known[part], value))
        raise error(f"{folder} holds {what} {differs}; choose another folder, or remove it")


def _first_difference(name: str, before: object, now: object) -> tuple[str, str, str]:
    """Which leaf of a part differs, and what it was and is, cut to a few words."""
    if isinstance(before, dict) and isinstance(now, dict):
        one, other = cast("dict[str, object]", before), cast("dict[str, object]", now)
        key = next(key for key in one | other if (key in one, one.get(key)) != (key in other, other.get(key)))
        return _first_difference(f"{name}.{key}", one.get(key), other.get(key))
    texts = [repr(each) for each in cast("list[object]", [before, now])]
    same = next((k for k, pair in enumerate(zip(*texts, strict=False)) if pair[0] != pair[1]), 0)
    first = max(same - _MOST_CHARACTERS // 3, 0) if max(map(len, texts)) > _MOST_CHARACTERS else 0
    last = first + _MOST_CHARACTERS
    was, is_now = ("…" * (first > 0) + text[first:last] + "…" * (last < len(text)) for text in texts)
    return name, was, is_now

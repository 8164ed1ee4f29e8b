"""The card of a weights file: which network it belongs to and what frames that network wants.

The same JSON stands in the header of the `.safetensors` files that roadproof writes, or beside any file as
`NAME.json`::

    {
      "format": "roadproof-controller", "version": 1,
      "architecture": "pilotnet", "activation": "elu", "target_speed_mps": 6.0,
      "preparation": {"frame_size": [88, 200], "rows": [15, 81], "network_size": [66, 200],
                      "colour": "yuv", "mean": [0.5, 0.5, 0.5], "std": [0.5, 0.5, 0.5]}
    }

Only `format` and `version` must be there. An exported network (`.onnx`, `.pt2`) has no architecture.
"""

from __future__ import annotations

import difflib
import json
from dataclasses import asdict, dataclass, fields
from typing import Any, cast

from roadproof.controllers.frames import FramePreparation
from roadproof.controllers.tracking import LAWS, LinearMPC, PurePursuit, law_name
from roadproof.errors import ControllerError

CARD_FORMAT = "roadproof-controller"
CARD_VERSION = 1

PLANNERS = ("waypoint", "temporal")
"""Architectures that answer with points."""

_NUMBERS_PER_FIELD = {"frame_size": 2, "rows": 2, "network_size": 2, "mean": 3, "std": 3}


@dataclass(frozen=True, kw_only=True, slots=True)
class ControllerCard:
    """What a weights file does not say by itself.

    Args:
        architecture: "cil", "pilotnet", "conditional-pilotnet", "waypoint" or "temporal", or None for an exported
            network.
        width: factor on CIL's channels and units, 1 by default.
        activation: activation of PilotNet, "elu" or "relu".
        target_speed_mps: speed in m/s that is held when a network that only steers drives, 6 by default.
        preparation: how frames become the network's input; None for the architecture's own.
        tracking: law that steers along the points that the network answers with; None for a network that steers.
        dt_s: time between those points, seconds; None where they have no times.
        frames_apart_s: time between the frames that an exported network takes at once, seconds, a multiple of 0.05;
            None for a network that takes one frame.
        origin: what the weights were made from, in words; None if it is not said.

    Raises:
        ControllerError: a law for a network that steers, or a time between points or frames that has nothing to act on.
    """

    architecture: str | None = None
    width: float = 1.0
    activation: str = "elu"
    target_speed_mps: float = 6.0
    preparation: FramePreparation | None = None
    tracking: PurePursuit | LinearMPC | None = None
    dt_s: float | None = None
    frames_apart_s: float | None = None
    origin: str | None = None

    def __post_init__(self) -> None:
        """Refuse what would change nothing."""
        if self.tracking is not None and self.architecture not in (None, *PLANNERS):
            raise ControllerError(
                f"tracking is for networks that answer with points, {self.architecture} steers; drop it"
            )
        if self.dt_s is not None and (self.tracking is None or self.architecture is not None):
            raise ControllerError(
                f"dt_s is {self.dt_s}, but only exported networks with a tracking law have points whose times it could "
                "be; give tracking or drop dt_s"
            )
        if self.frames_apart_s is not None and self.architecture is not None:
            raise ControllerError(
                f"frames_apart_s is {self.frames_apart_s}, but only exported networks may take several frames at once, "
                f"and this is {self.architecture}; drop it"
            )

    def to_json(self) -> str:
        """The card as text, with its format version."""
        stated = {name: value for name, value in asdict(self).items() if value is not None}
        if self.tracking is not None:
            stated["tracking"] = {"law": law_name(self.tracking), **stated["tracking"]}
        return json.dumps({"format": CARD_FORMAT, "version": CARD_VERSION, **stated}, indent=2)


def read_card(text: str, source: str) -> ControllerCard:
    """Read the card from its JSON text.

    Args:
        text: the card as JSON text.
        source: file or place of the card, for messages.

    Raises:
        ControllerError: the text is not a card, is of another version, or has an unknown key or a wrong kind of value.
    """
    try:
        card: object = json.loads(text)
    except json.JSONDecodeError as error:
        raise ControllerError(f"card {source} is not JSON: {error}") from error
    stated = _object(card, source)
    if stated.pop("format", None) != CARD_FORMAT:
        raise ControllerError(f'card {source} is not a controller card, expected "format": "{CARD_FORMAT}"')
    if (version := stated.pop("version", None)) != CARD_VERSION:
        raise ControllerError(f"card {source} has version {version!r}, this roadproof reads version {CARD_VERSION}")
    _known(stated, ControllerCard, source)
    values: dict[str, Any] = {
        name: _text(stated, name, source) for name in ("architecture", "activation", "origin") if name in stated
    }
    values |= {
        name: _number(stated[name], name, source)
        for name in ("width", "target_speed_mps", "dt_s", "frames_apart_s")
        if name in stated
    }
    if "preparation" in stated:
        values["preparation"] = _preparation(_object(stated["preparation"], source), source)
    if "tracking" in stated:
        values["tracking"] = _tracking(_object(stated["tracking"], source), source)
    return ControllerCard(**values)


def _tracking(stated: dict[str, object], source: str) -> PurePursuit | LinearMPC:
    law = LAWS.get(str(stated.pop("law", None)))
    if law is None:
        raise ControllerError(f"card {source}: tracking needs a law, one of {', '.join(LAWS)}")
    _known(stated, cast("type", law), source)
    whole = {field.name for field in fields(law) if isinstance(field.default, int)}
    numbers = {
        name: _numbers([value], 1, name, source)[0] if name in whole else _number(value, name, source)
        for name, value in stated.items()
    }
    return law(**cast("dict[str, Any]", numbers))


def _preparation(stated: dict[str, object], source: str) -> FramePreparation:
    _known(stated, FramePreparation, source)
    values: dict[str, Any] = {name: value for name, value in stated.items() if value is not None}
    for name, count in _NUMBERS_PER_FIELD.items():
        if name in values:
            values[name] = _numbers(values[name], count, name, source)
    if "colour" in values:
        values["colour"] = _text(values, "colour", source)
    return FramePreparation(**values)


def _object(value: object, source: str) -> dict[str, object]:
    if not isinstance(value, dict):
        raise ControllerError(f"card {source} holds {value!r} where a JSON object is expected")
    return dict(cast("dict[str, object]", value))


def _known(stated: dict[str, object], noun: type, source: str) -> None:
    names = [field.name for field in fields(noun)]
    for key in stated:
        if key not in names:
            nearest = difflib.get_close_matches(key, names, n=1)
            hint = f"did you mean {nearest[0]!r}?" if nearest else f"expected one of {', '.join(names)}"
            raise ControllerError(f"card {source} has an unknown key {key!r}; {hint}")


def _text(stated: dict[str, Any], name: str, source: str) -> str:
    if not isinstance(stated[name], str):
        raise ControllerError(f"card {source}: {name} is {stated[name]!r}, expected text")
    return stated[name]


def _number(value: object, name: str, source: str) -> float:
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise ControllerError(f"card {source}: {name} is {value!r}, expected a number")
    return float(value)


def _numbers(value: object, count: int, name: str, source: str) -> tuple[float | int, ...]:
    if not isinstance(value, list) or len(cast("list[object]", value)) != count:
        raise ControllerError(f"card {source}: {name} is {value!r}, expected a list of {count} numbers")
    numbers = tuple(_number(item, name, source) for item in cast("list[object]", value))
    if name in ("mean", "std"):
        return numbers
    if any(number != int(number) for number in numbers):
        raise ControllerError(f"card {source}: {name} is {value!r}, expected whole numbers")
    return tuple(int(number) for number in numbers)

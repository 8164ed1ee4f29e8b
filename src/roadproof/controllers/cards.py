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

import json
from dataclasses import asdict, dataclass, fields
from typing import Any, cast

from roadproof.controllers.frames import FramePreparation
from roadproof.controllers.tracking import LAWS, LinearMPC, PurePursuit, law_name
from roadproof.errors import ControllerError
from roadproof.io.files import one_line
from roadproof.io.tables import build
from roadproof.io.text import parse_json

CARD_FORMAT = "roadproof-controller"
CARD_VERSION = 1

PLANNERS = ("waypoint", "temporal")
"""Architectures that answer with points."""

_USED = {
    None: ("target_speed_mps", "preparation", "tracking", "dt_s", "frames_apart_s"),
    "cil": ("width",),
    "pilotnet": ("activation", "target_speed_mps", "preparation"),
    "conditional-pilotnet": ("preparation",),
    **dict.fromkeys(PLANNERS, ("preparation", "tracking")),
}
"""What a card may say besides the architecture and the origin, by architecture; None is an exported network."""


@dataclass(frozen=True, kw_only=True, slots=True)
class _Stated:
    """The fields of a card in their order, its law of whatever type: that depends on the law's name."""

    architecture: str | None = None
    width: float = 1.0
    activation: str = "elu"
    target_speed_mps: float = 6.0
    preparation: FramePreparation | None = None
    tracking: object = None
    dt_s: float | None = None
    frames_apart_s: float | None = None
    origin: str | None = None


@dataclass(frozen=True, kw_only=True, slots=True)
class ControllerCard(_Stated):
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
        ControllerError: a law for a network that steers, a time between points or frames that has nothing to act on,
            or anything else that would change nothing.
    """

    tracking: PurePursuit | LinearMPC | None = None

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

        # An architecture that is not known is refused where its network is made.
        used = _USED.get(self.architecture, tuple(each.name for each in fields(self)))
        for field in fields(self):
            value = getattr(self, field.name)
            if field.name not in ("architecture", "origin", *used) and value != field.default:
                whose = self.architecture or "an exported network"
                raise ControllerError(f"{field.name} is {value!r:.80}, for which {whose} has no use; drop it")

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
        stated = parse_json(text)
    except TypeError:
        shown = " ".join(text.split())
        raise ControllerError(f"card {source} holds {shown:.60} where a JSON object is expected") from None
    except (ValueError, RecursionError) as error:
        raise ControllerError(f"card {source} is not JSON: {one_line(error)}") from None
    if stated.pop("format", None) != CARD_FORMAT:
        raise ControllerError(f'card {source} is not a controller card, expected "format": "{CARD_FORMAT}"')
    if (version := stated.pop("version", None)) != CARD_VERSION:
        raise ControllerError(f"card {source} has version {version!r}, this roadproof reads version {CARD_VERSION}")
    typed = build(_Stated, stated, f"card {source}", ControllerError)
    values: dict[str, Any] = {name: getattr(typed, name) for name in stated}
    if "tracking" in stated:
        values["tracking"] = _law(_object(stated["tracking"], source), source)
    return ControllerCard(**values)


def _law(stated: dict[str, object], source: str) -> PurePursuit | LinearMPC:
    law = LAWS.get(str(stated.pop("law", None)))
    if law is None:
        raise ControllerError(f"card {source}: tracking needs a law, one of {', '.join(LAWS)}")
    return build(law, stated, f"card {source}: tracking", ControllerError)


def _object(value: object, source: str) -> dict[str, object]:
    if not isinstance(value, dict):
        raise ControllerError(f"card {source} holds {value!r} where a JSON object is expected")
    return dict(cast("dict[str, object]", value))

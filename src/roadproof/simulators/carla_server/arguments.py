"""Types and ranges of what clients send, and arguments read as a method's annotations declare them.

The ranges keep NaN, infinity and numbers that do not fit the wire's 32 bits out of the world.

Convention:
    Poses are ((x, y, z), (pitch, yaw, roll)) in metres and degrees, in CARLA's left-handed world.
"""

from __future__ import annotations

import inspect
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Annotated, Any, TypeAlias, get_type_hints

import msgspec
from msgspec import Meta, Raw
from msgspec.msgpack import Decoder

from roadproof.errors import SimulatorError
from roadproof.simulators.carla_server import limits
from roadproof.simulators.carla_server.wire import Value

SHOWN_BYTES = 200
MALFORMED = (msgspec.MsgspecError, OverflowError, RecursionError, TypeError, ValueError)
"""What reading bytes that a client made up can raise."""

Id: TypeAlias = Annotated[int, Meta(ge=0, le=2**32 - 1)]
Int32: TypeAlias = Annotated[int, Meta(ge=-(2**31), le=2**31 - 1)]
Port: TypeAlias = Annotated[int, Meta(ge=0, le=2**16 - 1)]
Byte: TypeAlias = Annotated[int, Meta(ge=0, le=255)]
Text: TypeAlias = Annotated[str, Meta(max_length=limits.TEXT_CHARACTERS)]
Number: TypeAlias = Annotated[float, Meta(ge=-1e9, le=1e9)]
Metres: TypeAlias = Annotated[float, Meta(ge=-limits.POSITION_M, le=limits.POSITION_M)]
Degrees: TypeAlias = Annotated[float, Meta(ge=-36_000.0, le=36_000.0)]
Mps: TypeAlias = Annotated[float, Meta(ge=-limits.SPEED_MPS, le=limits.SPEED_MPS)]
Level: TypeAlias = Annotated[float, Meta(ge=-100.0, le=100.0)]

Ids: TypeAlias = Annotated[list[Id], Meta(max_length=limits.ITEMS)]
Texts: TypeAlias = Annotated[list[Text], Meta(max_length=limits.ITEMS)]
Place: TypeAlias = tuple[Metres, Metres, Metres]
WirePose: TypeAlias = tuple[Place, tuple[Degrees, Degrees, Degrees]]
Velocity: TypeAlias = tuple[Mps, Mps, Mps]
Description: TypeAlias = tuple[Id, Text, Annotated[list[tuple[Text, Int32, Text]], Meta(max_length=64)]]
"""An actor to spawn: the number and the name of its blueprint, and attributes as (name, type, value)."""

VehicleControl: TypeAlias = tuple[Level, Level, Level, bool, bool, bool, Int32]
"""Throttle, steer, brake, hand brake, reverse, manual gear shift, gear."""

WalkerControl: TypeAlias = tuple[tuple[Level, Level, Level], Mps, bool]
"""A walker's direction, its speed in m/s, and whether it jumps."""

Weather: TypeAlias = Annotated[tuple[Number, ...], Meta(min_length=14, max_length=14)]
FixedStep: TypeAlias = Annotated[list[bool | Number], Meta(max_length=2)]
Settings: TypeAlias = tuple[bool, bool, FixedStep, bool, Number, Int32, Number, bool, Number, Number, bool]
Side: TypeAlias = Annotated[int, Meta(ge=0, le=2**16)]
Texture: TypeAlias = tuple[Side, Side, list[tuple[Byte, Byte, Byte, Byte]]]
"""Width, height, and RGBA row by row."""

Commands: TypeAlias = Annotated[list[tuple[tuple[Id, Raw]]], Meta(max_length=limits.ITEMS)]
"""Commands of a batch: for each, which one of CARLA's commands it is, and its fields."""

SpawnCommand: TypeAlias = tuple[
    Description, WirePose, Annotated[list[bool | Id], Meta(max_length=2)], int, Text, Commands
]
"""The parent is [false] or [true, id]; client 0.9.16 sends whatever is in its memory as the kind of attachment; at last
come the commands for the new actor."""


@dataclass(frozen=True, slots=True)
class Signature:
    """The arguments that a method takes from the wire.

    Args:
        names: the names of the parameters.
        decoders: for each parameter, what reads its argument as its annotation declares.
    """

    names: tuple[str, ...]
    decoders: tuple[Decoder[Any], ...]

    @classmethod
    def of(cls, method: Callable[..., Value]) -> Signature:
        """The signature of a bound method whose parameters are all annotated."""
        hints = get_type_hints(method, include_extras=True)
        return cls.taking(**{name: hints[name] for name in inspect.signature(method).parameters})

    @classmethod
    def taking(cls, **types: Any) -> Signature:  # noqa: ANN401
        """The signature with parameters of these names and types."""
        return cls(tuple(types), tuple(Decoder(kind) for kind in types.values()))

    def read(self, call: str, arguments: Sequence[Raw]) -> list[Value]:
        """The arguments of a call.

        Raises:
            SimulatorError: there are more or fewer arguments, or one is of another type or out of range.
        """
        if len(arguments) != len(self.names):
            expected = f"{len(self.names)} ({', '.join(self.names)})" if self.names else "none"
            raise SimulatorError(f"{call} was called with {len(arguments)} arguments, expected {expected}")
        pairs = zip(self.names, self.decoders, arguments, strict=True)
        return [read(f"{name} of {call}", decoder, argument) for name, decoder, argument in pairs]


def read(what: str, decoder: Decoder[Any], sent: Raw) -> Value:
    """Read one value that a client sent.

    Raises:
        SimulatorError: the value is of another type or out of range; the message says what it is and what was expected.
    """
    try:
        return decoder.decode(sent)
    except MALFORMED as error:
        reason = " ".join(str(error).split())
        raise SimulatorError(f"{what} is {_shown(sent)}: {reason[:1].lower()}{reason[1:]}") from None


def _shown(sent: Raw) -> str:
    raw = bytes(sent)
    if len(raw) > SHOWN_BYTES:
        return f"wrong ({len(raw)} bytes)"
    try:
        return f"{msgspec.msgpack.decode(raw)!r:.100}"
    except MALFORMED:
        return "not msgpack"

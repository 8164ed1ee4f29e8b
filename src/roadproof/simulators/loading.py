"""Which simulator is meant: "town" is the embedded one, "town:egl" the same drawn by OpenGL.

"carla://HOST:PORT" is a CARLA server; it is told how to paint by `?paint=` and inject, native or auto after its port.
"""

from __future__ import annotations

from collections.abc import Generator
from contextlib import contextmanager
from typing import Protocol, get_args
from urllib.parse import urlsplit

from roadproof.errors import SimulatorError
from roadproof.roads.maps import Mapped
from roadproof.simulators.protocol import OpenWorld, PaintChoice, Simulator

TOWNS = {"town": "software", "town:egl": "egl"}
"""The specs of the town, and what draws it."""

SPECS = "town, town:egl or carla://HOST:PORT"
RECORDED = "recorded:"
"""Begins the spec of recordings that are driven in, which are no simulator."""

CARLA_PORT, LAST_PORT = 2000, 65534  # sensor data goes through the next
_PAINTS: dict[str, PaintChoice] = {"": "inject", **{f"paint={choice}": choice for choice in get_args(PaintChoice)}}


class MappedSimulator(Simulator, OpenWorld, Mapped, Protocol):
    """A simulator that hides nothing of its drives, and also shows the map."""


def is_server(spec: str) -> bool:
    """Whether all processes that open this simulator step the same one."""
    return spec.startswith("carla://")


def is_elsewhere(spec: str) -> bool:
    """Whether the simulator of a spec is on another machine.

    Raises:
        SimulatorError: the spec is no address.
    """
    return is_server(spec) and _address(spec)[0] not in ("localhost", "127.0.0.1", "::1")


def check_spec(spec: str) -> None:
    """See that a spec names a simulator, before any work; whether it is there shows when it is opened.

    Raises:
        SimulatorError: no simulator has this name, or the spec is no address.
    """
    if spec.startswith(RECORDED):
        raise SimulatorError(f"simulator {spec!r} is a recorded world, which evaluate, select and drive alone drive in")
    if is_server(spec):
        _address(spec)
    elif spec not in TOWNS:
        raise SimulatorError(f"simulator {spec!r} is unknown, expected {SPECS}")


@contextmanager
def open_simulator(spec: str) -> Generator[MappedSimulator]:
    """Open the simulator of a spec for a with-block; leaving frees everything it holds.

    Raises:
        SimulatorError: no simulator has this name, or what it needs is not installed.
    """
    check_spec(spec)
    if spec in TOWNS:
        # Panda3D is an extra.
        from roadproof.simulators.town.simulator import TownSimulator

        with TownSimulator(graphics=TOWNS[spec]) as town:
            yield town
        return
    host, port, paint = _address(spec)
    # CARLA's client is an extra.
    from roadproof.simulators.carla.simulator import CarlaSimulator

    with CarlaSimulator(host, port, paint=paint) as server:
        yield server


def _address(spec: str) -> tuple[str, int, PaintChoice]:
    """Host, port and paint of carla://HOST:PORT?paint=PAINT; a port left out is CARLA's own, paint is injected."""
    try:
        parts = urlsplit(spec)
        host, port = parts.hostname, parts.port
    except ValueError as error:
        raise SimulatorError(f"simulator {spec!r} is no address ({error}), expected carla://HOST:PORT") from None
    if port is not None and not 1 <= port <= LAST_PORT:
        raise SimulatorError(f"simulator {spec!r} has port {port}, expected 1 to {LAST_PORT:,}")
    if not host or parts.path or parts.fragment or parts.username:
        raise SimulatorError(f"simulator {spec!r} is no address, expected carla://HOST:PORT")
    if parts.query not in _PAINTS:
        raise SimulatorError(
            f"simulator {spec!r} asks for {parts.query!r}, expected nothing or paint= and one of inject, native, auto"
        )
    return host, CARLA_PORT if port is None else port, _PAINTS[parts.query]

"""The two ports of a server, side by side: calls on one, streams on the next."""

from __future__ import annotations

import contextlib
import ipaddress
import os
import socket
from collections.abc import Generator
from dataclasses import dataclass

from roadproof.errors import SimulatorError

LAST_PORT = 65534
TRIES = 64
BACKLOG = 128

Address = tuple[socket.AddressFamily, str]


@dataclass(frozen=True, slots=True)
class Ports:
    """Sockets that listen.

    Args:
        number: the port for calls; streams are on the next.
        calls: a socket for each address of the host, on the port for calls.
        streams: a socket for each address of the host, on the next port.
    """

    number: int
    calls: tuple[socket.socket, ...]
    streams: tuple[socket.socket, ...]


@contextlib.contextmanager
def open_ports(host: str, port: int, *, allow_remote: bool = False) -> Generator[Ports]:
    """Listen on two ports beside each other, and close them at the end.

    Args:
        host: name or address to listen on.
        port: the port for calls, 0 to 65534; 0 takes any that is free with the next one.
        allow_remote: whether the host may be another than this machine's loopback.

    Raises:
        SimulatorError: the port is out of range or taken, the host has no address here, or is not loopback and
            `allow_remote` is not given.
    """
    if not 0 <= port <= LAST_PORT:
        raise SimulatorError(f"the port is {port}, expected 0 to {LAST_PORT}: streams need the next one")
    addresses = _addresses(host)
    if not allow_remote and not all(ipaddress.ip_address(address).is_loopback for _, address in addresses):
        raise SimulatorError(
            f"host {host!r} is not this machine's loopback: whoever reaches the port could drive, spawn and load maps, "
            "without a password; listen on 127.0.0.1, or give --allow-remote on a network you trust"
        )
    for left in reversed(range(1 if port else TRIES)):
        chosen = port or _free_port(addresses[0], host)
        with contextlib.ExitStack() as stack:
            try:
                calls, streams = (
                    tuple(stack.enter_context(_listening(each, number, host)) for each in addresses)
                    for number in (chosen, chosen + 1)
                )
            except SimulatorError:
                if left:
                    continue
                raise
            yield Ports(chosen, calls, streams)
            return


def _addresses(host: str) -> list[Address]:
    try:
        found = socket.getaddrinfo(host or None, 0, type=socket.SOCK_STREAM, flags=socket.AI_PASSIVE)
    except (OSError, UnicodeError) as error:
        raise SimulatorError(
            f"host {host!r:.100} has no address ({error}); expected a name or address of this machine, as 127.0.0.1"
        ) from None
    return list(dict.fromkeys((family, str(address[0]).split("%")[0]) for family, *_, address in found))


def _free_port(address: Address, host: str) -> int:
    """A port that the operating system chooses, and that leaves room for the next."""
    with _listening(address, 0, host) as found:
        return min(int(found.getsockname()[1]), LAST_PORT)


def _listening(address: Address, port: int, host: str) -> socket.socket:
    family, numbers = address
    made = socket.socket(family, socket.SOCK_STREAM)
    try:
        if os.name == "posix":
            # A port that was in use a moment ago is free; elsewhere this would take it from another program.
            made.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        if family == socket.AF_INET6:
            made.setsockopt(socket.IPPROTO_IPV6, socket.IPV6_V6ONLY, 1)
        made.bind((numbers, port))
        made.listen(BACKLOG)
        made.setblocking(False)
    except OSError as error:
        made.close()
        raise SimulatorError(
            f"port {port} of {host} cannot be opened ({error.strerror}); calls need --port and streams the next: "
            "choose another"
        ) from None
    return made

"""The server: calls on one port, streams on the next, one world behind both."""

from __future__ import annotations

import asyncio
import contextlib
import logging
import signal
import struct
import threading
import time
from collections.abc import Callable, Generator, Sequence
from pathlib import Path

from roadproof.simulators.carla_server import limits, wire
from roadproof.simulators.carla_server.blueprints import CAMERAS, COLLISION_SENSOR
from roadproof.simulators.carla_server.calls import Calls
from roadproof.simulators.carla_server.connections import Connection, Connections
from roadproof.simulators.carla_server.ports import Ports, open_ports
from roadproof.simulators.carla_server.requests import NotARequestError, Requests
from roadproof.simulators.carla_server.sensors import collision_message, picture_message, world_message
from roadproof.simulators.carla_server.wire import WORLD_STREAM
from roadproof.simulators.carla_server.world import FREE_RUN_S, NO_RENDERING, SYNCHRONOUS, World


class Server:
    """Serves one world to any number of clients, from one thread.

    Args:
        world: the world that is served, with a map loaded.
        ports: the two ports, which already listen.
    """

    def __init__(self, world: World, ports: Ports) -> None:
        self._world, self._ports = world, ports
        self._told = world.episode
        self._listeners: dict[int, list[Connection]] = {}
        self._calls = Calls(world, ports.number, self.advance)

    async def run(self, ready: Callable[[], object]) -> None:
        """Serve until cancelled; `ready` is called once clients are answered."""
        async with Connections() as connections:
            for sockets, handle in ((self._ports.calls, self._serve_calls), (self._ports.streams, self._serve_stream)):
                for listening in sockets:
                    connections.accept(listening, handle)
            ready()
            while True:
                episode = self._world.episode
                await asyncio.sleep(FREE_RUN_S)
                free = not self._world.settings[SYNCHRONOUS] and self._world.episode == episode
                if free and self._listeners.get(WORLD_STREAM):
                    self._advance_freely()

    def advance(self) -> None:
        """Take a step and tell everyone, the first time on another map also that it is another.

        Never with the answer to the call that loads it: the client opens its stream anew then, and one of version
        0.9.16 dies if news of another map come through the old one meanwhile. CARLA itself takes longer to load.
        """
        hits = self._world.step()
        changed, self._told = self._told != self._world.episode, self._world.episode
        for sensor in list(self._world.actors.values()):
            if not self._listeners.get(sensor.stream):
                continue
            if sensor.name in CAMERAS and not self._world.settings[NO_RENDERING]:
                self.send(sensor.stream, picture_message(self._world, sensor), once=False)
            elif sensor.name == COLLISION_SENSOR:
                for hit in hits:
                    if hit.actor.id == sensor.parent:
                        self.send(sensor.stream, collision_message(self._world, sensor, hit, self._ports.number + 1))
        self.send(WORLD_STREAM, world_message(self._world, time.time(), changed=changed), once=changed)

    def _advance_freely(self) -> None:
        """Take a step that nobody asked for."""
        try:
            self.advance()
        except Exception:
            # A mistake of this server that something in the world brings about; without it the next step goes well.
            logging.getLogger(__name__).exception("a step failed; the map is loaded anew")
            assert self._world.town is not None
            self._world.load(self._world.town.name)

    def send(self, stream: int, message: bytes, *, once: bool = True) -> None:
        """Send a message to all who listen to a stream, without waiting for any.

        What is not said `once`, but comes with every step, is left out for a listener who is behind while the world
        runs freely, as CARLA does. In synchronous mode, where clients count on every frame, it waits for them, and a
        listener with too much to take is dropped; CARLA makes the world wait.
        """
        framed = wire.framed(message)
        for listener in list(self._listeners.get(stream, ())):
            if once or self._world.settings[SYNCHRONOUS] or not listener.unsent:
                listener.post(framed)

    async def _serve_calls(self, connection: Connection) -> None:
        requests = Requests()
        try:
            while data := await connection.read(requests.waiting):
                requests.feed(data)
                for request in requests:
                    connection.heard()
                    if isinstance(request, NotARequestError):
                        await connection.send(request.answer)
                        continue
                    answer = self._calls.answer(request)
                    # Calls marked asynchronous take no answer.
                    if request.answered:
                        await connection.send(answer)
                    # Whoever sends many at once lets the others in between.
                    await asyncio.sleep(0)
        except NotARequestError as error:
            await connection.send(error.answer)
        except TimeoutError:
            late = requests.refusal(f"the rest of a message did not come within {limits.MESSAGE_S} s")
            await connection.send(late.answer)

    async def _serve_stream(self, connection: Connection) -> None:
        (stream,) = struct.unpack("<I", await connection.read_exactly(4, limits.STREAM_ID_S))
        if not self._world.has_stream(stream):
            await asyncio.sleep(limits.UNKNOWN_STREAM_S)
            return
        listeners = self._listeners.setdefault(stream, [])
        listeners.append(connection)
        try:
            if stream == WORLD_STREAM:
                connection.post(wire.framed(world_message(self._world, time.time())))
            while await connection.read():
                pass
        finally:
            listeners.remove(connection)
            if not listeners:
                self._listeners.pop(stream, None)


def serve(
    *,
    host: str = "127.0.0.1",
    port: int = 2000,
    maps: Sequence[Path] = (),
    first: str = "town",
    allow_remote: bool = False,
    ready: Callable[[int], object],
) -> None:
    """Serve the embedded town to CARLA's clients until interrupted or asked to end (SIGINT, SIGTERM).

    Args:
        host: name or address to listen on.
        port: the port for calls, 0 to 65534; streams are on the next. 0 takes any two that are free.
        maps: OpenDRIVE files to offer besides the built-in towns, by the names of the files.
        first: the name of the map at the start.
        allow_remote: whether the host may be another than this machine's loopback. Nobody is asked for a password, so
            whoever reaches the ports can drive, spawn and load maps.
        ready: called with the port for calls once clients are answered.

    Raises:
        SimulatorError: a port is out of range or taken, the host is not loopback and `allow_remote` is not given, the
            first map is unknown, or Panda3D or msgpack is not installed.
        ScenarioError: a map cannot be read.
    """
    with _ended_by_sigterm(), open_ports(host, port, allow_remote=allow_remote) as ports:
        world = World(maps)
        try:
            world.load(first)
            asyncio.run(_run(Server(world, ports), lambda: ready(ports.number)))
        except (KeyboardInterrupt, asyncio.CancelledError):
            pass
        finally:
            world.close()


async def _run(server: Server, ready: Callable[[], object]) -> None:
    task = asyncio.current_task()
    assert task is not None
    # Of the loop's own, which asks between two callbacks: an interrupt in the middle of one may be lost.
    with contextlib.suppress(NotImplementedError, RuntimeError):  # not on Windows, nor in another than the main thread
        for number in (signal.SIGINT, signal.SIGTERM):
            if signal.getsignal(number) is not signal.SIG_IGN:
                asyncio.get_running_loop().add_signal_handler(number, task.cancel)
    await server.run(ready)


@contextlib.contextmanager
def _ended_by_sigterm() -> Generator[None]:
    """While a map is being built, SIGTERM ends the process as Ctrl+C does."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    before = signal.signal(signal.SIGTERM, signal.default_int_handler)
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, before)

"""The sockets: calls on one port, streams on the next, one world behind both."""

from __future__ import annotations

import asyncio
import contextlib
import struct
import time
from collections.abc import Callable, Sequence
from pathlib import Path

from roadproof.errors import SimulatorError
from roadproof.simulators.carla_server import wire
from roadproof.simulators.carla_server.blueprints import CAMERAS, COLLISION_SENSOR
from roadproof.simulators.carla_server.calls import Calls
from roadproof.simulators.carla_server.sensors import collision_message, picture_message, world_message
from roadproof.simulators.carla_server.wire import WORLD_STREAM
from roadproof.simulators.carla_server.world import FREE_RUN_S, NO_RENDERING, SYNCHRONOUS, World

READ_BYTES = 1 << 16


class Server:
    """Serves one world to any number of clients, from one thread.

    Args:
        world: with a map loaded.
        port: of the calls; streams are on the next.
    """

    def __init__(self, world: World, port: int) -> None:
        self._world, self._port = world, port
        self._told = world.episode
        self._listeners: dict[int, list[asyncio.StreamWriter]] = {}
        self._calls = Calls(world, port, self.advance)

    async def run(self, host: str, ready: Callable[[], object]) -> None:
        """Serve until cancelled; `ready` is called once clients can connect.

        Raises:
            SimulatorError: a port is taken.
        """
        async with contextlib.AsyncExitStack() as stack:
            for port, handler in ((self._port, self._serve_calls), (self._port + 1, self._serve_stream)):
                try:
                    await stack.enter_async_context(await asyncio.start_server(handler, host, port))
                except OSError as error:
                    raise SimulatorError(
                        f"port {port} of {host} cannot be opened ({error.strerror}); calls need --port and streams the "
                        "next: choose another"
                    ) from error
            ready()
            while True:
                episode = self._world.episode
                await asyncio.sleep(FREE_RUN_S)
                free = not self._world.settings[SYNCHRONOUS] and self._world.episode == episode
                if free and self._listeners.get(WORLD_STREAM):
                    self.advance()

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
                self.send(sensor.stream, picture_message(self._world, sensor))
            elif sensor.name == COLLISION_SENSOR:
                for hit in hits:
                    if hit.actor.id == sensor.parent:
                        self.send(sensor.stream, collision_message(self._world, sensor, hit, self._port + 1))
        self.send(WORLD_STREAM, world_message(self._world, time.time(), changed=changed))

    def send(self, stream: int, message: bytes) -> None:
        """Send a message to all who listen to a stream."""
        for writer in list(self._listeners.get(stream, ())):
            if not writer.is_closing():
                writer.write(wire.framed(message))

    async def _serve_calls(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        unpacker = wire.unpacker()
        with contextlib.suppress(ConnectionError, asyncio.CancelledError):
            while data := await reader.read(READ_BYTES):
                unpacker.feed(data)
                for _, call_id, name, (metadata, *args) in unpacker:
                    result = self._calls.answer(name, args)
                    # Calls marked asynchronous take no answer.
                    if not metadata[0]:
                        writer.write(wire.request_answer(call_id, result))
                await writer.drain()
        writer.close()

    async def _serve_stream(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        listeners: list[asyncio.StreamWriter] = []
        with contextlib.suppress(asyncio.IncompleteReadError, ConnectionError, asyncio.CancelledError):
            (stream,) = struct.unpack("<I", await reader.readexactly(4))
            listeners = self._listeners.setdefault(stream, [])
            listeners.append(writer)
            if stream == WORLD_STREAM:
                self.send(stream, world_message(self._world, time.time()))
            while await reader.read(READ_BYTES):
                pass
        if writer in listeners:
            listeners.remove(writer)
        writer.close()


def serve(
    *,
    host: str = "127.0.0.1",
    port: int = 2000,
    maps: Sequence[Path] = (),
    first: str = "town",
    ready: Callable[[], object],
) -> None:
    """Serve the embedded town to CARLA's clients until interrupted.

    Args:
        host: address to listen on.
        port: of the calls; streams are on the next.
        maps: OpenDRIVE files to offer besides the built-in towns, by the names of the files.
        first: the map at the start.
        ready: called once clients can connect.

    Raises:
        SimulatorError: a port is taken, the first map is unknown, or Panda3D or msgpack is not installed.
        ScenarioError: a map cannot be read.
    """
    world = World(maps)
    try:
        world.load(first)
        asyncio.run(Server(world, port).run(host, ready))
    except KeyboardInterrupt:
        pass
    finally:
        world.close()

"""The connections of clients: how many there are, what they may hold, and how long they are waited for."""

from __future__ import annotations

import asyncio
import contextlib
import logging
import socket
from collections.abc import Awaitable, Callable
from types import TracebackType

from roadproof.simulators.carla_server import limits

READ_BYTES = 1 << 16
RETRY_S = 0.5
KEEPALIVE = {"TCP_KEEPIDLE": 60, "TCP_KEEPINTVL": 15, "TCP_KEEPCNT": 4}
"""Where the system has them: a peer that vanished without a word is noticed after two minutes."""


class Connection:
    """One client's connection.

    Attributes:
        heard_s: when the client last sent or took something whole, by the event loop's clock.
    """

    def __init__(self, everyone: Connections, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        self._everyone, self._reader, self._writer = everyone, reader, writer
        self._loop = asyncio.get_running_loop()
        self._begun_s: float | None = None
        self._unread = 0
        self.heard_s = self._loop.time()

    @property
    def unsent(self) -> int:
        """Bytes that the client has not taken."""
        return self._writer.transport.get_write_buffer_size()

    @property
    def held(self) -> int:
        """Bytes that wait here, both ways."""
        return self._unread + self.unsent

    def heard(self) -> None:
        """Note that a whole message came."""
        self.heard_s, self._begun_s = self._loop.time(), None

    async def read(self, unread: int = 0) -> bytes:
        """What comes in next; nothing at the end.

        Args:
            unread: bytes of a message that has begun; its end may come until `limits.MESSAGE_S` after its beginning.

        Raises:
            TimeoutError: the message did not end in time.
        """
        self._unread = unread
        self._everyone.bound()
        if not unread:
            self._begun_s = None
        elif self._begun_s is None:
            self._begun_s = self._loop.time()
        until = None if self._begun_s is None else self._begun_s + limits.MESSAGE_S
        async with asyncio.timeout_at(until):
            return await self._reader.read(READ_BYTES)

    async def read_exactly(self, count: int, within_s: float) -> bytes:
        """Read so many bytes.

        Raises:
            TimeoutError: the bytes did not come in time.
            EOFError: the client is gone.
        """
        async with asyncio.timeout(within_s):
            return await self._reader.readexactly(count)

    async def send(self, message: bytes) -> None:
        """Send a message and wait until the client takes it.

        Raises:
            TimeoutError: the client does not take it in time.
        """
        self._writer.write(message)
        self._everyone.bound()
        async with asyncio.timeout(limits.MESSAGE_S):
            await self._writer.drain()

    def post(self, message: bytes) -> None:
        """Send a message without waiting; a client that has too much to take is dropped."""
        if self._writer.transport.is_closing():
            return
        if self.unsent and self.unsent + len(message) > limits.LISTENER_BYTES:
            self.drop()
            return
        if not self.unsent:
            self.heard_s = self._loop.time()
        self._writer.write(message)
        self._everyone.bound()

    def drop(self) -> None:
        """Close the connection now; what waits is thrown away."""
        self._unread = 0
        self._writer.transport.abort()

    async def end(self) -> None:
        """Close the connection once the client has taken the last words, or does not."""
        with contextlib.suppress(OSError):
            async with asyncio.timeout(limits.FAREWELL_S):
                if not self._writer.transport.is_closing():
                    self._writer.write_eof()
                    # Closed with bytes unread, it would be reset, and the last words lost.
                    while await self._reader.read(READ_BYTES):
                        pass
                self._writer.close()
                await self._writer.wait_closed()
        self.drop()


class Connections:
    """All connections of a server. As a context manager it ends them."""

    def __init__(self) -> None:
        self._open: set[Connection] = set()
        self._tasks: set[asyncio.Task[None]] = set()
        self._slots = asyncio.Semaphore(limits.CONNECTIONS)

    async def __aenter__(self) -> Connections:
        return self

    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        for task in self._tasks:
            task.cancel()
        await asyncio.gather(*self._tasks, return_exceptions=True)

    def accept(self, listening: socket.socket, handle: Callable[[Connection], Awaitable[None]]) -> None:
        """Let clients connect; `handle` converses with each, and its end closes the connection."""
        self._begin(self._accept(listening, handle))

    def bound(self) -> None:
        """Drop the connection that holds most, while too much waits in all together."""
        while sum(connection.held for connection in self._open) > limits.HELD_BYTES:
            max(self._open, key=lambda connection: connection.held).drop()

    def _begin(self, work: Awaitable[None]) -> None:
        task = asyncio.ensure_future(work)
        self._tasks.add(task)
        task.add_done_callback(self._tasks.discard)

    async def _accept(self, listening: socket.socket, handle: Callable[[Connection], Awaitable[None]]) -> None:
        loop = asyncio.get_running_loop()
        while True:
            try:
                accepted, _ = await loop.sock_accept(listening)
            except OSError:  # it was gone again, or there are no more file descriptors
                await asyncio.sleep(RETRY_S)
                continue
            try:
                await self._slot()
            except BaseException:
                accepted.close()
                raise
            self._begin(self._converse(accepted, handle))

    async def _slot(self) -> None:
        """Wait until one more may connect; whoever has been quiet for long gives way."""
        while self._slots.locked():
            now_s = asyncio.get_running_loop().time()
            quiet = min(self._open, key=lambda connection: connection.heard_s, default=None)
            if quiet is not None and now_s - quiet.heard_s > limits.QUIET_S:
                quiet.drop()
            with contextlib.suppress(TimeoutError):
                async with asyncio.timeout(RETRY_S):
                    await self._slots.acquire()
                    return
        await self._slots.acquire()

    async def _converse(self, accepted: socket.socket, handle: Callable[[Connection], Awaitable[None]]) -> None:
        connection: Connection | None = None
        try:
            accepted.setsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE, 1)
            for name, value in KEEPALIVE.items():
                if hasattr(socket, name):
                    accepted.setsockopt(socket.IPPROTO_TCP, getattr(socket, name), value)
            reader = asyncio.StreamReader(READ_BYTES)
            protocol = asyncio.StreamReaderProtocol(reader)
            loop = asyncio.get_running_loop()
            transport, _ = await loop.connect_accepted_socket(lambda: protocol, accepted)
            connection = Connection(self, reader, asyncio.StreamWriter(transport, protocol, reader, loop))
            self._open.add(connection)
            with contextlib.suppress(OSError, EOFError):
                await handle(connection)
            await connection.end()
        except OSError:  # gone before it began
            pass
        except Exception:
            # A mistake of this server; the other clients are not to suffer for it.
            logging.getLogger(__name__).exception("a connection of a CARLA client ended")
        finally:
            if connection is not None:
                connection.drop()
                self._open.discard(connection)
            accepted.close()
            self._slots.release()

"""What a client sends, cut into requests.

A request is [0, id, name, [[asynchronous], argument, …]] in msgpack. Nothing is built of one before its last byte is
there, so what a header claims costs nothing.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Annotated

from msgspec import Meta, Raw
from msgspec.msgpack import Decoder

from roadproof.errors import SimulatorError
from roadproof.simulators.carla_server import limits
from roadproof.simulators.carla_server.arguments import MALFORMED, Id, Text
from roadproof.simulators.carla_server.wire import Value, msgpack, refused, request_answer, request_error

MAX_ARGUMENTS = 16
REQUEST = 0
HEAD_BYTES = 8
_TOO_LARGE = "a message is larger than {} bytes"
_ENVELOPE: Decoder[tuple[int, int, str, Raw]] = Decoder(tuple[int, Id, Text, Raw])
_PARAMETERS: Decoder[list[Raw]] = Decoder(Annotated[list[Raw], Meta(min_length=1, max_length=1 + MAX_ARGUMENTS)])
_METADATA: Decoder[tuple[bool]] = Decoder(tuple[bool])
_START: Decoder[Id] = Decoder(Id)


class NotARequestError(SimulatorError):
    """What came in is no request, so where the next one begins is not known.

    Args:
        text: what is wrong, for the client.
        call_id: id of the call; None where it cannot be read.

    Attributes:
        answer: what to tell the client. One that waits for the call raises the text; without a number it cannot.
    """

    def __init__(self, text: str, call_id: int | None = None) -> None:
        super().__init__(text)
        self.answer = request_error(0, text) if call_id is None else request_answer(call_id, refused(text))


@dataclass(frozen=True, slots=True)
class Request:
    """One call.

    Args:
        id: number that the client chose; the answer carries it.
        name: name of the call.
        arguments: the arguments, not yet read.
        answered: whether the client waits for an answer.
    """

    id: int
    name: str
    arguments: tuple[Raw, ...]
    answered: bool


class Requests:
    """Takes bytes as they come in and gives requests."""

    def __init__(self) -> None:
        self._bytes = bytearray()
        self._left_out = 0
        self._gone, self._scanner = 0, _scanner()

    @property
    def waiting(self) -> int:
        """Bytes of a request that has begun and has not ended."""
        return min(len(self._bytes) + self._left_out, limits.MESSAGE_BYTES)

    def feed(self, data: bytes) -> None:
        """Take what came in; only after all requests before were taken out.

        Raises:
            NotARequestError: a text in the bytes is too large.
        """
        self._bytes += data
        try:
            self._scanner.feed(data)
        except msgpack.BufferFull:
            raise self.refusal(_TOO_LARGE.format(limits.MESSAGE_BYTES)) from None

    def __iter__(self) -> Iterator[Request | NotARequestError]:
        """The requests that are whole; in place of one that is too large, what to answer.

        Raises:
            NotARequestError: the bytes are no request.
        """
        while self._bytes:
            try:
                self._scanner.skip()
            except msgpack.OutOfData:
                if len(self._bytes) + self._left_out > limits.MESSAGE_BYTES:
                    # Its end is waited for, so that the client can go on.
                    self._left_out += len(self._bytes) - HEAD_BYTES
                    del self._bytes[HEAD_BYTES:]
                return
            except ValueError as error:
                raise self.refusal(f"a message is not msgpack ({type(error).__name__})") from None
            end = self._scanner.tell()
            size = end - self._gone
            if size > limits.MESSAGE_BYTES:
                found: Request | NotARequestError = self.refusal(_TOO_LARGE.format(limits.MESSAGE_BYTES))
            else:
                found = self._request(bytes(self._bytes[:size]))
            del self._bytes[: size - self._left_out]
            self._left_out, self._gone = 0, end
            if not self._bytes:
                # The old one keeps the memory of its largest message.
                self._gone, self._scanner = 0, _scanner()
            yield found

    def refusal(self, text: str) -> NotARequestError:
        """What to raise over the message that has begun; with the message's id, where that is there."""
        # [0, id, …: an array of four, the type, the number.
        head = bytes(self._bytes[2:HEAD_BYTES])
        for size in range(1, len(head) + 1 if self._bytes.startswith(b"\x94\x00") else 0):
            try:
                return NotARequestError(text, _START.decode(head[:size]))
            except MALFORMED:
                continue
        return NotARequestError(text)

    def _request(self, message: bytes) -> Request:
        try:
            kind, call_id, name, parameters = _ENVELOPE.decode(message)
            metadata, *arguments = _PARAMETERS.decode(parameters)
            (asynchronous,) = _METADATA.decode(metadata)
        except MALFORMED as error:
            raise self.refusal(f"a message is no request [0, id, name, [[asynchronous], …]]: {error}") from None
        if kind != REQUEST:
            raise self.refusal(f"a message is of type {kind}, expected {REQUEST}, a request")
        return Request(call_id, name, tuple(arguments), not asynchronous)


def _scanner() -> Value:
    return msgpack.Unpacker(read_size=4096, max_buffer_size=limits.MESSAGE_BYTES)

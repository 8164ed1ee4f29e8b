"""A client of `roadproof carla serve` made of sockets and msgpack, which can be as rude as it likes."""

import contextlib
import socket
import struct
from pathlib import Path

import msgpack

PATIENCE_S = 30.0


class Caller:
    """A connection to the port of calls."""

    def __init__(self, port, patience_s=PATIENCE_S):
        self.socket = socket.create_connection(("127.0.0.1", port), timeout=patience_s)
        self.answers = msgpack.Unpacker(raw=False, max_buffer_size=1 << 30)
        self.count = 0

    def __enter__(self):
        return self

    def __exit__(self, *_):
        self.socket.close()

    def request(self, name, *arguments, answered=True):
        self.count += 1
        return msgpack.packb([0, self.count, name, [[not answered], *arguments]])

    def answer(self):
        """The next answer; None at the end of the connection."""
        while True:
            with contextlib.suppress(msgpack.OutOfData):
                return self.answers.unpack()
            try:
                data = self.socket.recv(1 << 16)
            except ConnectionResetError:
                data = b""
            if not data:
                return None
            self.answers.feed(data)

    def call(self, name, *arguments):
        """The result of a call, as it is on the wire."""
        self.socket.sendall(self.request(name, *arguments))
        kind, number, error, result = self.answer()
        assert (kind, number, error) == (1, self.count, None)
        return result

    def tell(self, name, *arguments):
        """A call that takes no answer."""
        self.socket.sendall(self.request(name, *arguments, answered=False))

    def granted(self, name, *arguments):
        """What a call gives."""
        ((granted, *value),) = self.call(name, *arguments)
        assert granted is False or granted == 1, value
        return value[0] if value else None

    def refused(self, name, *arguments):
        """Why a call is refused."""
        ((which, (text,)),) = self.call(name, *arguments)
        assert which == 0
        return text

    def synchronous(self, on=True):
        self.granted("set_episode_settings", [on, False, [True, 0.05], True, 0.01, 10, 0.0, True, 3000.0, 2000.0, True])

    def spawn(self, name, x=20.0, y=1.75, parent=None, **attributes):
        """An actor as it is on the wire."""
        given = [[key, 4, str(value)] for key, value in attributes.items()]
        place = [[x, y, 0.3], [0.0, 0.0, 0.0]] if parent is None else [[0.0, 0.0, 2.0], [0.0, 0.0, 0.0]]
        if parent is None:
            return self.granted("spawn_actor", [0, name, given], place)
        return self.granted("spawn_actor_with_parent", [0, name, given], place, parent, 0, "")

    def clear(self, *actors):
        for actor in actors:
            self.granted("destroy_actor", actor)


def listen(port, stream, *, buffer_bytes=None):
    """A connection to a stream."""
    made = socket.socket()
    if buffer_bytes is not None:
        made.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, buffer_bytes)
    made.settimeout(PATIENCE_S)
    made.connect(("127.0.0.1", port + 1))
    made.sendall(struct.pack("<I", stream))
    return made


def stream_of(actor):
    """The number of a sensor's stream."""
    return struct.unpack_from("<I", actor[5])[0]


def message(listener):
    """The next message of a stream."""
    (size,) = struct.unpack("<I", exactly(listener, 4))
    return exactly(listener, size)


def frame_of(sent):
    return struct.unpack_from("<QQ", sent)[1]


def exactly(listener, size):
    parts = bytearray()
    while len(parts) < size:
        part = listener.recv(size - len(parts))
        if not part:
            raise EOFError
        parts += part
    return bytes(parts)


def memory_mb(process):
    """Resident, of a process on Linux."""
    lines = Path(f"/proc/{process.pid}/status").read_text().splitlines()
    return next(int(line.split()[1]) for line in lines if line.startswith("VmRSS")) / 1024


def connections(process):
    """How many files and sockets a process has open, on Linux."""
    return len(list(Path(f"/proc/{process.pid}/fd").iterdir()))

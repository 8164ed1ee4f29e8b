"""The most that a client may ask of `roadproof carla serve`, and how long the server waits for one.

Every number of this kind stands here once; docs/carla.md lists them for users.
"""

CONNECTIONS = 256
"""Open at once, calls and streams together. Further ones wait until one ends or gives way."""

QUIET_S = 10.0
"""When all connections are in use, the one that has been quiet for longest gives way, if for at least this long."""

MESSAGE_BYTES = 16 << 20
"""Bytes of one call; room for a texture of about 1300×1300 pixels."""

MESSAGE_S = 30.0
"""Time from the first byte of a call to its last, and time for a client to take the answer."""

STREAM_ID_S = 10.0
"""Time for a client that connects to the port of streams to say which one it wants."""

UNKNOWN_STREAM_S = 1.0
"""Time until a connection to a stream that does not exist is closed: CARLA's client connects again without a pause."""

LISTENER_BYTES = 64 << 20
"""Bytes that may wait for one listener; a single message may be larger."""

HELD_BYTES = 256 << 20
"""Bytes that may wait in all connections together, calls and sensor data."""

FAREWELL_S = 2.0
"""Time for a client to take the last words before its connection is closed."""

ACTORS = 2000
"""Actors in the world at once."""

VEHICLE_PAIRS = 40_000
"""Vehicles that move by themselves times all vehicles, since each meets all others: 200, or 80 among 500."""

CAMERA_PIXELS = 1 << 24
"""Pixels of all cameras together: one of 4096×4096, or 34 of 800×600."""

ITEMS = 10_000
"""Entries of one list: commands of a batch, ids, names of objects."""

TEXT_CHARACTERS = 256
"""Characters of a name, an address or the value of an attribute."""

POSITION_M = 100_000.0
"""Coordinates, to either side of the origin."""

SPEED_MPS = 200.0
"""Each component of a velocity, and the speed of a walker."""

STEP_S = 1.0
"""The longest fixed step; a longer one would hold up all other clients."""

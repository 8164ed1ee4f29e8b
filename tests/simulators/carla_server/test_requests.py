"""Requests cut out of bytes that come in any pieces."""

import pytest

msgpack = pytest.importorskip("msgpack", reason="serving needs the extra roadproof[carla]")

from hypothesis import given
from hypothesis import strategies as st

from fuzzing import tries
from roadproof.simulators.carla_server import limits
from roadproof.simulators.carla_server.requests import NotARequestError, Requests

VALUES = st.recursive(
    st.none()
    | st.booleans()
    | st.integers(-(2**63), 2**64 - 1)
    | st.floats()
    | st.text(max_size=20)
    | st.binary(max_size=20),
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.text(max_size=5), inner, max_size=3),
    max_leaves=10,
)
REQUESTS = st.tuples(st.integers(0, 2**32 - 1), st.text(max_size=20), st.booleans(), st.lists(VALUES, max_size=5))


def taken(pieces):
    requests = Requests()
    found = []
    for piece in pieces:
        requests.feed(piece)
        found += list(requests)
    assert requests.waiting == 0
    return found


@tries(200)
@given(st.lists(REQUESTS, max_size=5), st.lists(st.integers(1, 40), min_size=1))
def test_requests_are_the_same_in_whatever_pieces_they_come(sent, sizes):
    data = b"".join(msgpack.packb([0, number, name, [[hurried], *args]]) for number, name, hurried, args in sent)
    pieces, at = [], 0
    while at < len(data):
        size = sizes[len(pieces) % len(sizes)]
        pieces.append(data[at : at + size])
        at += size
    found = taken(pieces)
    assert [(each.id, each.name, not each.answered) for each in found] == [each[:3] for each in sent]
    assert [[bytes(raw) for raw in each.arguments] for each in found] == [
        [msgpack.packb(value) for value in each[3]] for each in sent
    ]


@tries(500)
@given(st.binary(max_size=200))
def test_any_bytes_are_requests_or_refused_or_waited_for(data):
    requests = Requests()
    requests.feed(data)
    try:
        list(requests)
    except NotARequestError as error:
        kind, _, _, _ = msgpack.unpackb(error.answer)
        assert kind == 1


def test_a_refusal_carries_the_number_of_its_call_where_that_has_come():
    for number in (0, 127, 128, 2**16, 2**32 - 1):
        requests = Requests()
        requests.feed(msgpack.packb([0, number, "version", [[False], "x" * 50]])[:-20])
        assert list(requests) == []
        assert msgpack.unpackb(requests.refusal("too late").answer) == [1, number, None, [[0, ["too late"]]]]


@pytest.mark.parametrize("piece", [1, 7, 100, 5000])
def test_what_is_too_large_is_left_out_and_the_next_request_is_met(monkeypatch, piece):
    monkeypatch.setattr(limits, "MESSAGE_BYTES", 10_000)
    large = msgpack.packb([0, 300, "paint", [[False], [[1, 2, 3]] * 10_000]])
    small = msgpack.packb([0, 301, "version", [[False]]])
    data = small + large + small + large + small
    requests, found, most = Requests(), [], 0
    for at in range(0, len(data), piece):
        requests.feed(data[at : at + piece])
        found += list(requests)
        most = max(most, requests.waiting)
    assert [getattr(each, "name", None) for each in found] == ["version", None, "version", None, "version"]
    assert msgpack.unpackb(found[1].answer) == [1, 300, None, [[0, ["a message is larger than 10000 bytes"]]]]
    assert most <= 10_000
    assert requests.waiting == 0


def test_a_text_that_is_too_large_is_refused_as_soon_as_it_is(monkeypatch):
    monkeypatch.setattr(limits, "MESSAGE_BYTES", 10_000)
    requests = Requests()
    requests.feed(b"\x94\x00\x07\xa1f\x92\x91\xc2\xc6\xff\xff\xff\xff" + bytes(9000))
    assert list(requests) == []
    with pytest.raises(NotARequestError, match="larger than 10000 bytes"):
        requests.feed(bytes(2000))

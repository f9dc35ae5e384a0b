"""Modbus frames at the host: in any pieces, after any data, with any bit flipped."""

import struct
from itertools import pairwise

from hypothesis import given
from hypothesis import strategies as st

from drivers.codec.modbus.adu import (
    ModbusResponse,
    RequestAdu,
    ResponseReader,
    build_adu,
    framed,
)
from drivers.statistics import WireCounters

WORDS = (4711, *range(12))


def asked_and_answered(is_rtu: bool) -> tuple[RequestAdu, bytes]:
    """Make a request of registers and the frame of its response, FC4 by hand."""
    transaction = 0 if is_rtu else 300
    request = build_adu(1, transaction, 3200, len(WORDS), is_rtu=is_rtu)
    pdu = struct.pack(f">BB{len(WORDS)}H", 4, 2 * len(WORDS), *WORDS)
    return request, framed(1, pdu, transaction, is_rtu=is_rtu)


EXAMPLES = {is_rtu: asked_and_answered(is_rtu) for is_rtu in (True, False)}


def read(is_rtu: bool, *pieces: bytes) -> tuple[list[ModbusResponse], WireCounters]:
    """Feed pieces to a reader; its responses and counters."""
    counters = WireCounters()
    reader = ResponseReader(is_rtu=is_rtu, counters=counters)
    request = EXAMPLES[is_rtu][0]
    return [one for piece in pieces for one in reader.feed(piece, request)], counters


def accepted(answers: list[ModbusResponse]) -> list[tuple[int, ...]]:
    """Registers of the responses that a wire would accept, by their tag."""
    return [one.registers for one in answers if one.registers[:1] == WORDS[:1]]


@given(is_rtu=st.booleans(), cuts=st.lists(st.integers(0, 40)), garbage=st.binary(max_size=12))
def test_response_is_found_in_any_pieces(is_rtu: bool, cuts: list[int], garbage: bytes) -> None:
    """Over RTU also after garbage."""
    stream = (garbage if is_rtu else b"") + EXAMPLES[is_rtu][1]
    edges = sorted({0, len(stream), *(cut for cut in cuts if cut < len(stream))})
    pieces = [stream[a:b] for a, b in pairwise(edges)]
    answers, _ = read(is_rtu, *pieces)
    assert accepted(answers) == [WORDS]

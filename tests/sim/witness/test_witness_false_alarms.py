"""Correct traffic, of which the witness must report nothing: not for its own delays either."""

import struct
import zlib

import pytest
from cobs import cobs

from sim.witness.witness import Witness
from witness_config import witness_of_one


def frame(kind: int, payload: str, *, sequence: int, version: int = 2) -> bytes:
    """A serial frame of address 1, as the page defines it."""
    body = struct.pack("<BBBH", kind, version, 1, sequence) + bytes.fromhex(payload)
    return b"\0" + cobs.encode(body + struct.pack("<L", zlib.crc32(body))) + b"\0"


STATUS = "04 00 0000 01 FA00 {left} 0807 00 04 0000 0000 0000 0000"


def left(milliseconds: int) -> str:
    """A status of an armed amplifier with this watchdog_left."""
    return STATUS.format(left=struct.pack("<H", milliseconds).hex())


def armed_witness() -> Witness:
    """A witness that has seen an Arm with 250 ms at 0.01 s."""
    witness = witness_of_one()
    witness.record_bytes("a", "amplifier", 0.010, frame(3, "FA00 0900", sequence=1))
    witness.record_bytes("a", "host", 0.011, frame(0x83, left(250), sequence=1))
    return witness


@pytest.mark.parametrize(("reported", "is_wrong"), [(240, False), (231, False), (225, True)])
def test_watchdog_left_is_as_a_host_allows(reported: int, is_wrong: bool) -> None:
    """Within 11 ms, as the page says; 9 ms after Arm 241 ms are left."""
    witness = armed_witness()
    witness.record_bytes("a", "amplifier", 0.0195, frame(9, "", sequence=2))
    witness.record_bytes("a", "host", 0.020, frame(0x89, left(reported), sequence=2))
    assert [one.invariant for one in witness.finish()] == ["watchdog"] * is_wrong


@pytest.mark.parametrize(("delay", "is_missing"), [(0.0, True), (0.1, False)])
def test_reply_is_not_late_by_the_delay_of_the_witness(delay: float, is_missing: bool) -> None:
    """It is seen 100 ms after its request, of which this program did not run for that long."""
    witness = armed_witness()
    witness.record_bytes("a", "amplifier", 0.050, frame(9, "", sequence=2))
    if delay:
        witness.delayed(0.150, delay)
    witness.record_bytes("a", "host", 0.150, frame(0x89, left(120), sequence=2))
    assert [one.invariant for one in witness.finish()] == ["answer"] * is_missing


def test_stop_with_a_ramp_out_of_range_is_clipped() -> None:
    """The page allows it: an amplifier that carries it out is right."""
    witness = armed_witness()
    witness.record_bytes("a", "amplifier", 0.020, frame(8, "FFFF", sequence=2))
    stopped = left(0).replace("04 00", "05 00", 1)
    witness.record_bytes("a", "host", 0.021, frame(0x88, stopped, sequence=2))
    assert witness.finish() == []

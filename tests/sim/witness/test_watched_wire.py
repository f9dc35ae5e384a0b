"""One watched wire: what counts as disturbed."""

import pytest

from sim.witness.watched_wire import WatchedWire

# A response of Modbus TCP to function 3 with two bytes, of which a fault cuts the last four.
RESPONSE = bytes.fromhex("0001 0000 0005 01 03 02 1234")


@pytest.mark.parametrize(("cut", "is_disturbed"), [(4, True), (0, False)])
def test_a_cut_frame_disturbs_until_bytes_have_followed(cut: int, is_disturbed: bool) -> None:
    """The next response, 0.6 s after the fault, is read as the cut one's rest: 0.5 s from then."""
    wire = WatchedWire("line", "modbus-tcp", {})
    wire.set_disturbed(1.0, is_on=True)
    wire.feed("host", 1.05, RESPONSE[: len(RESPONSE) - cut])
    wire.set_disturbed(1.1, is_on=False)
    assert wire.is_disturbed(1.6)
    assert not wire.is_disturbed(1.61)
    wire.feed("host", 1.7, RESPONSE)
    assert wire.is_disturbed(2.2) is is_disturbed
    assert not wire.is_disturbed(2.21)

"""Where every frame comes late no amplifier is taken for faulty, and clicks are felt or counted."""

from collections import Counter

import pytest

from chain import set_running
from courses import Acted
from late_taps import AMPLIFIERS, WIRES, play
from virtual_lines import in_virtual_time

_ROWS = [(wire, amplifiers, 1) for wire in WIRES for amplifiers in AMPLIFIERS]


# The others: three on a line were not fed in time, or one that replied again was not heard.
@pytest.mark.parametrize(
    ("wire", "amplifiers", "seed"), [*_ROWS, ("modbus", 3, 12), ("modbus", 3, 64)]
)
def test_late_frames_are_no_fault(wire: str, amplifiers: int, seed: int) -> None:
    """Up to 16 ms either way: nothing is wrong, and each click that was not played is counted.

    But for some that come while all is disarmed. On one amplifier, in one exchange, all may be.
    """
    counts = play(wire, amplifiers, seed)
    taps, played, too_late = map(counts.pop, ("taps", "played", "too late"))
    assert not counts - Counter(["clicks"] * taps)
    assert too_late > 0 or amplifiers == 1
    assert played + too_late >= 0.9 * taps


@in_virtual_time
async def test_watchdog_that_stands_still_is_found_where_replies_are_late() -> None:
    """On a line that amplifiers share, where one commit feeds all of them before each in turn."""
    async with set_running("a", "b", of=Acted, wire="modbus-rtu") as chain:
        chain.witness.disturb()  # a status goes before what feeds
        chain.delays(0.012)
        await chain.holds(1.0, "finger")
        assert chain.controller.group.is_armed
        chain.answer("GetStatus", watchdog_left=250)
        await chain.holds(3.0, "finger")
        assert not chain.controller.group.is_armed

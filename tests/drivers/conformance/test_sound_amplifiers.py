"""A sound amplifier on every wire, in virtual time: conformance and the witness find no fault."""

import asyncio

import pytest

from conformance_bench import ALL, results_on
from drivers.conformance import CHECKS, Result
from long_form import shortly
from model.rig.rig import Rig
from witness_config import witness_of_one

INVALID = (
    "invalid_frames",
    "invalid_frames_do_not_feed",
    "tolerated_frames",
    "broadcasts",
    "addresses",
)
KINDS = {
    "serial": "serial",
    "modbus+tcp": "modbus-tcp",
    "modbus+rtu": "modbus-rtu",
    "can+slcan": "slcan",
}
BROKEN_BY_CONFORMANCE = {"enabled", "limits", "token", "credit", "stop", "voices"}
"""Rules for hosts that it breaks on purpose."""


@pytest.mark.parametrize("wire", shortly(ALL, ["serial"]))
def test_sound_amplifier_passes_and_breaks_no_rule(wire: str, coarse_rig: Rig) -> None:
    """In half a minute of traffic; skipped are checks for which there is nothing to check."""
    witness = witness_of_one(KINDS[wire])

    def seen(link: str, toward: str, data: bytes) -> None:
        now = asyncio.get_running_loop().time()
        witness.record_bytes("a", "amplifier" if toward == "amplifier" else "host", now, data)

    valid = [check for check in CHECKS if check.name not in INVALID]
    invalid = [check for check in CHECKS if check.name in INVALID]
    results = results_on(wire, coarse_rig, valid, seen=seen) + results_on(wire, coarse_rig, invalid)
    assert {one.check.name: one.problem for one in results if one.problem} == {}
    skipped = {one.check.name for one in results if one.result is Result.SKIPPED}
    assert skipped <= {"steps_as_stated", "frames_in_any_order", "vanished_host"}
    assert sum(one.seconds for one in results) < 60
    broken = [one for one in witness.finish() if one.invariant not in BROKEN_BY_CONFORMANCE]
    assert broken == []
    assert witness.frames > 4000

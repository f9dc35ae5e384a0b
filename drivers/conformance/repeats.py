"""Checks of what must not be taken for a repeat, and of numbers at the ends of their ranges."""

from typing import Any

from drivers.conformance.bench import Bench
from drivers.conformance.check import driving
from drivers.conformance.findings import MeasuredNotApplicable, expect
from drivers.guard import SafeCommandSet
from drivers.protocol.definition import PROTOCOL
from drivers.protocol.messages import AmplifierState, Feature

_SETS = "wire-protocol.md#sets-tokens-and-ramps"
_Q = PROTOCOL.quantities
_MAX_TIME = 8.0  # s; that stops may take


@driving(_SETS)
async def altered_repeats(bench: Bench) -> None:
    """It refuses the set that plays if it comes again with any one field altered."""
    can, has_end = bench.can, bench.has(Feature.VALID_FOR)
    lasts = 5.0 if has_end else 0.0
    await bench.arm()
    active = bench.tones(1.0, valid_for=lasts)
    await bench.apply(active)
    altered: list[tuple[str, dict[str, Any]]] = [
        ("frequency", {"frequency": bench.frequency + max(can.frequency_step, 1.0)}),
        ("keep phase", {"keep_phase": True}),
    ]
    if bench.has(Feature.PHASE):
        altered.append(("phase", {"phase": 20.0}))
    if can.ramp_max:
        altered.append(("ramp", {"ramp": bench.ramp}))
    if has_end:
        altered += [("valid_for", {"valid_for": one}) for one in (0.0, lasts + 0.001)]
    repeats: list[tuple[str, SafeCommandSet]] = [
        (f"another {name}", bench.tones(1.0, **{"valid_for": lasts, **values}, token=active.token))
        for name, values in altered
    ]
    if can.channels > 1:
        more = bench.tones(1.0, 0.5, valid_for=lasts, token=active.token)
        repeats.append(("one more channel", more))
    for name, repeat in repeats:
        what = f"the token that plays, with {name}"
        await bench.refused(bench.amplifier.apply(repeat), what=what)
    await bench.expect_levels(1.0, why="after altered repeats")


@driving(_SETS)
async def max_valid_for(bench: Bench) -> None:
    """It plays on under the longest valid_for, and half of it."""
    bench.require(Feature.VALID_FOR)
    await bench.arm()
    for lasts in (_Q.valid_for.high, 0.6 * _Q.valid_for.high):
        when = await bench.play(1.0, valid_for=lasts)
        await bench.pause_until(when.latest + 0.06)
        await bench.expect_levels(1.0, why=f"under valid_for of {lasts:g} s")


@driving("wire-protocol.md#states")
async def latch_wraps(bench: Bench) -> None:
    """It numbers stops from 1 to 255, then 1 again."""
    largest = int(_Q.latch.high)
    if largest * bench.exchange_time > _MAX_TIME:
        raise MeasuredNotApplicable(f"the wire is too slow for {largest} Stops")
    before = (await bench.amplifier.status()).latch
    for _ in range(largest + 1):  # it may begin at 0
        latch = (await bench.amplifier.stop(0.0)).latch
        following = before % largest + 1
        expect(latch == following, f"latch after {before}", expected=following, seen=latch)
        has_wrapped, before = before == largest, latch
        if has_wrapped:
            break
    status = await bench.amplifier.clear(before)
    bench.expect_state(status, AmplifierState.SWITCH_ON_DISABLED, after="Clear")

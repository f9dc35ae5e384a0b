"""Checks of what an output plays, at several levels and frequencies."""

import math

from drivers.command import CommandSet, DriveCommand
from drivers.conformance.bench import Bench
from drivers.conformance.check import driving
from drivers.conformance.findings import expect

_FRACTIONS = (1.0, 0.5, 0.1)  # of the test level


@driving("wire-protocol.md#sets-tokens-and-ramps")
async def levels_of_every_frequency(bench: Bench) -> None:
    """It plays the levels that it reports, at the ends of its frequencies and between."""
    limits, can = bench.guard.limits, bench.can
    between = math.sqrt(limits.frequency_min * limits.frequency_max)
    middle = (limits.frequency_min + limits.frequency_max) / 2
    await bench.arm()
    for target in (limits.frequency_min, between, middle, limits.frequency_max):
        frequency = min(max(target, limits.frequency_min), limits.frequency_max)
        for fraction in _FRACTIONS:
            level = fraction * bench.level
            commands = tuple(
                DriveCommand(channel, frequency, level) for channel in range(can.channels)
            )
            token = bench.amplifier.next_token()
            requested = CommandSet(token, commands, ramp=0.0, valid_for=0.0)
            reply = await bench.amplifier.apply(bench.guard.check(requested))
            why = f"a set of level {level:.4g} at {frequency:g} Hz"
            for played in reply.commands:
                is_right = (
                    abs(played.frequency - frequency) <= can.frequency_step / 2 + 0.026
                    and abs(played.level - level) <= can.level_step / 2 + 1e-4
                )
                expect(
                    is_right,
                    f"achieved of channel {played.channel} by {why}",
                    expected=(round(frequency, 3), round(level, 4)),
                    seen=(played.frequency, played.level),
                )
            await bench.expect_levels(*(fraction,) * can.channels, why=why)

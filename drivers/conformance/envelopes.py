"""Checks of envelopes, on amplifiers that support them."""

from drivers.command import CommandSet, DriveCommand, Envelope, Knot
from drivers.conformance.bench import LEVEL_TOLERANCE, Bench, expect


async def envelopes(bench: Bench) -> None:
    """It plays onset and ending envelopes through their knots, if it reports any."""
    if not bench.can.envelope_knots:
        return
    await bench.arm()
    step = min(max(0.1, bench.can.envelope_step_min), bench.can.envelope_step_max)
    for slot, fraction in ((1, 0.5), (2, 0.25)):
        shape = Envelope(slot, step, (Knot(fraction * bench.level, 0.0),) * 2)
        await bench.amplifier.load_envelope(bench.guard.check_envelope(shape))
    shaped = DriveCommand(0, bench.frequency, bench.level, onset=1, ending=2)
    token = bench.amplifier.next_token()
    safe = bench.guard.check(CommandSet(token, (shaped,), ramp=0.0, valid_for=0.0))
    achieved = await bench.amplifier.apply(safe)
    expect(
        (achieved.commands[0].onset, achieved.commands[0].ending) == (1, 2),
        "achieved slots must be those requested",
    )
    status = await bench.amplifier.status()
    expect(
        status.levels[0] < bench.level * 0.9, f"level must begin at zero, got {status.levels[0]:g}"
    )
    await bench.until(
        lambda status: abs(status.levels[0] - bench.level) <= LEVEL_TOLERANCE,
        what="end of an onset",
        feed=True,
    )
    await bench.amplifier.apply(bench.tones())
    level = (await bench.levels())[0]
    expect(level > 0, "level must follow the ending, got silence at once")
    await bench.until(lambda status: not any(status.levels), what="end of an ending", feed=True)


async def missing_envelopes(bench: Bench) -> None:
    """It refuses a set that refers to an empty slot; the playing set stays."""
    if not bench.can.envelope_slots:
        return
    slot = bench.can.envelope_slots
    step = bench.can.envelope_step_max
    full = bench.guard.check_envelope(Envelope(slot, step, (Knot(0.0, 0.0),)))
    await bench.amplifier.load_envelope(full)
    await bench.arm()
    await bench.amplifier.apply(bench.tones(1.0))
    shaped = DriveCommand(0, bench.frequency, bench.level, onset=slot)
    token = bench.amplifier.next_token()
    safe = bench.guard.check(CommandSet(token, (shaped,), ramp=0.0, valid_for=0.0))
    await bench.amplifier.load_envelope(bench.guard.check_envelope(Envelope(slot, step, ())))
    await bench.refused(bench.amplifier.apply(safe), what="a set with an empty slot")
    await bench.expect_levels(1.0, why="after a refused set")

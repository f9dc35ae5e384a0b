"""Envelopes, where the amplifier has them."""

from drivers.command import CommandSet, DriveCommand, Envelope, Knot
from drivers.conformance.bench import LEVEL_ERROR, Bench, expect


async def envelopes(bench: Bench) -> None:
    """It plays envelopes through their knots, endings too, where it says that it can."""
    if not bench.can.envelope_knots:
        return
    await bench.arm()
    step = min(max(0.1, bench.can.envelope_step_min), bench.can.envelope_step_max)
    for slot, share in ((1, 0.5), (2, 0.25)):
        shape = Envelope(slot, step, (Knot(share * bench.level, 0.0),) * 2)
        await bench.amplifier.load_envelope(bench.guard.check_envelope(shape))
    shaped = DriveCommand(0, bench.frequency, bench.level, onset=1, ending=2)
    token = bench.amplifier.next_token()
    safe = bench.guard.check(CommandSet(token, (shaped,), ramp=0.0, valid_for=0.0))
    achieved = await bench.amplifier.apply(safe)
    expect(
        (achieved.commands[0].onset, achieved.commands[0].ending) == (1, 2),
        "the slots are not those that were asked",
    )
    status = await bench.amplifier.status()
    expect(status.levels[0] < bench.level * 0.9, "it does not begin at zero")
    await bench.until(
        lambda status: abs(status.levels[0] - bench.level) <= LEVEL_ERROR,
        what="the end of an onset",
        feed=True,
    )
    await bench.amplifier.apply(bench.tones())
    level = (await bench.levels())[0]
    expect(level > 0, "it is silent at once although it has an ending")
    await bench.until(lambda status: not any(status.levels), what="the end of an ending", feed=True)


async def missing_envelopes(bench: Bench) -> None:
    """It refuses a set that refers to an envelope it has not; what plays plays on."""
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
    await bench.expect_levels(1.0, why="after a refused set the one before plays on")

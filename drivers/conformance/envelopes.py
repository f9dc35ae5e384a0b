"""Checks of envelopes, on amplifiers that support them."""

from drivers.command import Envelope, Knot
from drivers.conformance.bench import Bench
from drivers.conformance.check import driving
from drivers.conformance.curve import along, expect_curve, raised_cosine, samples_until
from drivers.conformance.ending import is_silent
from drivers.conformance.findings import Inconclusive, NotApplicable, expect
from drivers.operation.plausibility import CYCLE
from drivers.protocol.messages import Feature

_PLACE = "wire-protocol.md#envelopes"


def step_of(bench: Bench) -> float:
    """Return a step [s] that is long against an exchange; NotApplicable without envelopes."""
    if not bench.can.envelope_knots:
        raise NotApplicable("it has no envelopes")
    requested = max(0.1, 20 * bench.exchange_time)
    return min(max(requested, bench.can.envelope_step_min), bench.can.envelope_step_max)


async def load(bench: Bench, slot: int, *amplitudes: complex) -> None:
    """Load an envelope of knots at these complex amplitudes, relative to the test level."""
    knots = tuple(
        Knot(abs(one) * bench.level, 180.0 if one.real < 0 else 0.0) for one in amplitudes
    )
    envelope = Envelope(slot, step_of(bench), knots)
    await bench.amplifier.load_envelope(bench.guard.check_envelope(envelope))


@driving(_PLACE)
async def onsets(bench: Bench) -> None:
    """It begins along an onset through its knots, from silence, whatever the ramp."""
    step, level = step_of(bench), bench.level
    await load(bench, 1, 0.75, 0.25)
    await bench.arm()
    shaped = bench.tones(1.0, onset=1, ending=0, ramp=0.0)
    achieved = await bench.amplifier.apply(shaped)
    slots = [(one.onset, one.ending) for one in achieved.commands]
    expect(slots == [(1, 0)], "achieved slots", expected=[(1, 0)], seen=slots)
    await bench.play()
    when = await bench.apply(bench.tones(1.0, onset=1))
    rising = along(step, 0.0, 0.75 * level, 0.25 * level, level)
    samples = await samples_until(bench, when.latest + 3.2 * step)
    expect_curve(bench, samples, rising, commit=when, lasts=3 * step, what="of an onset")
    await bench.expect_levels(1.0, why="after an onset")


@driving(_PLACE)
async def endings(bench: Bench) -> None:
    """It ends along the ending of the set that plays: by a silent set, and by valid_for."""
    step, level = step_of(bench), bench.level
    await load(bench, 2, 0.5, -0.5)
    falling = along(step, level, 0.5 * level, -0.5 * level, 0.0)
    await bench.arm()
    for last in ((), (0.0,)):
        await bench.apply(bench.tones(1.0, ending=2))
        when = await bench.play(*last)
        samples = await samples_until(bench, when.latest + 3.2 * step)
        expect_curve(bench, samples, falling, commit=when, lasts=3 * step, what="of an ending")
        await bench.expect_levels(why="after an ending")
    if not bench.has(Feature.VALID_FOR):
        return
    lasts = 2 * step
    when = await bench.apply(bench.tones(1.0, ending=2, valid_for=lasts))
    samples = await samples_until(bench, when.latest + lasts + 3.2 * step)
    expect_curve(
        bench,
        samples,
        falling.after(lasts),
        commit=when,
        lasts=lasts + 3 * step,
        what="of an ending by valid_for",
    )


@driving(_PLACE)
async def endings_amid_onsets(bench: Bench) -> None:
    """It ends along the ending from the present amplitude amid an onset to level 0, too."""
    step, level = step_of(bench), bench.level
    if bench.can.envelope_knots < 2:
        raise NotApplicable("an onset of one knot has no level that stays")
    await load(bench, 1, 1.0, 1.0)
    await load(bench, 2, 0.5)
    await bench.arm()
    started = await bench.apply(bench.tones(0.0, onset=1, ending=2))
    await bench.pause_until(started.latest + 1.3 * step)
    when = await bench.play()
    if when.latest > started.earliest + 2 * step:
        raise Inconclusive("the silent set came after the level that stays")
    falling = along(step, level, 0.5 * level, 0.0)
    samples = await samples_until(bench, when.latest + 2.2 * step)
    what = "of an ending amid an onset to level 0"
    expect_curve(bench, samples, falling, commit=when, lasts=2 * step, what=what)
    await bench.expect_levels(why="after such an ending")


@driving(_PLACE)
async def skipped_endings(bench: Bench) -> None:
    """It skips an ending by the flag, by Stop and by Disarm, each along its ramp."""
    step_of(bench)
    await load(bench, 2, 1.0)
    ramp = bench.ramp
    falling = raised_cosine(ramp, start=bench.level, end=0.0)
    for name in ("flag", "Disarm", "Stop"):
        await bench.arm()
        await bench.apply(bench.tones(1.0, ending=2))
        if name == "flag":
            when = await bench.apply(bench.tones(0.0, skip_ending=True, ramp=ramp))
        else:
            end = bench.amplifier.disarm if name == "Disarm" else bench.amplifier.stop
            _, when = await bench.timed(end(ramp))
        samples = await samples_until(bench, when.latest + 1.3 * ramp, feed=name == "flag")
        expect_curve(
            bench, samples, falling, commit=when, lasts=ramp, what=f"of an ending skipped by {name}"
        )
        await bench.rest()


@driving(_PLACE)
async def interrupted_endings(bench: Bench) -> None:
    """It ends an ending amid which a longer ramp begins when it would have ended."""
    step = step_of(bench)
    await load(bench, 2, 1.0)
    await bench.arm()
    await bench.apply(bench.tones(1.0, ending=2))
    ended = await bench.play()
    await bench.pause_until(ended.latest + step)
    await bench.play(ramp=min(4 * step, bench.can.ramp_max))
    what = "silence of an ending before a longer ramp"
    silent = await bench.time_of(is_silent, since=ended, due=2 * step, what=what)
    bench.expect_time(what, silent, low=0.0, high=2 * step + CYCLE)


@driving(_PLACE)
async def loaded_while_playing(bench: Bench) -> None:
    """It plays a set by the envelopes of its Stage, whatever is loaded afterwards."""
    step, level = step_of(bench), bench.level
    await load(bench, 1, 0.5)
    await load(bench, 2, 0.5)
    bench.require(Feature.STAGING)
    await bench.arm()
    staged = bench.tones(1.0, onset=1, ending=2)
    await bench.amplifier.stage(staged)
    await load(bench, 1, 1.0)
    _, when = await bench.timed(bench.amplifier.commit(staged.token))
    await load(bench, 2, 1.0)
    rising = along(step, 0.0, 0.5 * level, level)
    samples = await samples_until(bench, when.latest + 2.2 * step)
    expect_curve(
        bench, samples, rising, commit=when, lasts=2 * step, what="of an onset loaded before"
    )
    when = await bench.play()
    falling = along(step, level, 0.5 * level, 0.0)
    samples = await samples_until(bench, when.latest + 2.2 * step)
    expect_curve(
        bench, samples, falling, commit=when, lasts=2 * step, what="of an ending loaded before"
    )


@driving(_PLACE)
async def kept_phase_onset(bench: Bench) -> None:
    """It begins an onset with keep phase at the present amplitude, and without at zero."""
    step, level = step_of(bench), bench.level
    await load(bench, 1, 0.5)
    for keep_phase, start in ((True, level), (False, 0.0)):
        await bench.arm()
        await bench.play(1.0)
        requested = bench.tones(1.0, onset=1, keep_phase=keep_phase, ramp=0.0)
        when = await bench.apply(requested)
        curve = along(step, start, 0.5 * level, level)
        samples = await samples_until(bench, when.latest + 2.2 * step)
        after = [one for one in samples if one.when.earliest > when.latest + 0.002]
        expect_curve(bench, after, curve, commit=when, lasts=2 * step, what="of an onset")
        await bench.amplifier.disarm(0.0)


@driving(_PLACE)
async def watchdog_skips_endings(bench: Bench) -> None:
    """It skips endings when the watchdog trips."""
    bench.require(Feature.WATCHDOG)
    step_of(bench)
    await load(bench, 2, 1.0)
    await bench.arm(bench.can.watchdog_min)
    await bench.apply(bench.tones(1.0, ending=2))
    what = "silence by the watchdog, of a set with an ending"
    due = bench.watchdog + 0.005
    silent = await bench.time_of(is_silent, since=bench.fed, due=due, what=what)
    bench.expect_time(what, silent, low=bench.watchdog, high=due + 0.005)


@driving(_PLACE)
async def missing_envelopes(bench: Bench) -> None:
    """It refuses a set that refers to an empty slot; the playing set stays."""
    step_of(bench)
    slot = bench.can.envelope_slots
    await load(bench, slot, 0.5)
    await bench.arm()
    await bench.play(1.0)
    shaped = {"onset": bench.tones(1.0, onset=slot), "ending": bench.tones(1.0, ending=slot)}
    await load(bench, slot)
    for name, requested in shaped.items():
        await bench.refused(bench.amplifier.apply(requested), what=f"an {name} from an empty slot")
        await bench.refused(bench.amplifier.stage(requested), what=f"an {name} from an empty slot")
        await bench.expect_levels(1.0, why="after a refused set")

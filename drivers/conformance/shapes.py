"""Checks of envelopes at the ends of what an amplifier states: knots, steps, slots, phases."""

import math
from collections.abc import Sequence

from drivers.command import CommandSet, DriveCommand, Envelope, Knot
from drivers.conformance.bench import Bench
from drivers.conformance.check import driving
from drivers.conformance.curve import along, expect_curve, samples_until
from drivers.conformance.ending import is_silent
from drivers.conformance.envelopes import load, step_of
from drivers.conformance.findings import ContractViolation, NotApplicable
from drivers.errors import CommandRefused
from drivers.guard import SafeCommandSet
from drivers.operation.plausibility import CYCLE
from drivers.protocol.messages import Feature

_PLACE = "wire-protocol.md#envelopes"
_CAPS = "wire-protocol.md#getcaps"
_WHOLE = 0.4  # s; of an envelope of many knots
_SAMPLES = 6  # exchanges at least in one step of it
_KEPT_PHASE_KNOT = 0.5  # of the test level
_PHASES = (180.0, 120.0, -120.0, 90.0, -90.0, 60.0)  # degrees; of the channels in turn


async def _shape(bench: Bench, slot: int, step: float, *fractions: float) -> None:
    """Load an envelope with a step [s] of its own, knots at fractions of the test level."""
    shaped = _of(bench, slot, step, *fractions)
    await bench.amplifier.load_envelope(bench.guard.check_envelope(shaped))


def _of(bench: Bench, slot: int, step: float, *fractions: float) -> Envelope:
    knots = tuple(Knot(one * bench.level, 0.0) for one in fractions)
    return Envelope(slot, step, knots)


@driving(_PLACE)
async def max_knots(bench: Bench) -> None:
    """It moves along an envelope of as many knots as it states."""
    step_of(bench)
    can, level = bench.can, bench.level
    count = can.envelope_knots
    requested = max(_WHOLE / (count + 1), _SAMPLES * bench.exchange_time)
    step = min(max(round(requested, 3), can.envelope_step_min), can.envelope_step_max)
    # Down and up again, so that neither order nor number can be another.
    fractions = [0.6 + 0.4 * math.cos(3 * math.pi * (at + 1) / count) for at in range(count)]
    await _shape(bench, 1, step, *fractions)
    await bench.arm()
    await bench.apply(bench.tones(1.0, ending=1))
    when = await bench.play()
    lasts = (count + 1) * step
    falling = along(step, level, *(one * level for one in fractions), 0.0)
    samples = await samples_until(bench, when.latest + lasts + 0.05)
    what = f"of an ending of {count} knots"
    expect_curve(bench, samples, falling, commit=when, lasts=lasts, what=what)
    await bench.expect_levels(why=f"after an ending of {count} knots")


@driving(_CAPS)
async def extreme_steps(bench: Bench) -> None:
    """It plays envelopes of the shortest and of the longest step in their time."""
    step_of(bench)
    can = bench.can
    count = can.envelope_knots
    few = min(count, 2)
    for step, knots in ((can.envelope_step_min, count), (can.envelope_step_max, few)):
        await _shape(bench, 1, step, *(1.0,) * knots)
        await bench.arm()
        await bench.apply(bench.tones(1.0, ending=1))
        ended = await bench.play()
        due = (knots + 1) * step
        what = f"silence of an ending of {knots} knots, {step * 1e3:g} ms apart"
        silent = await bench.time_of(is_silent, since=ended, due=due, what=what, feed=True)
        # The last step of a level may round to silence.
        low = due - step * bench.can.level_step / bench.level
        bench.expect_time(what, silent, low=low, high=due + CYCLE)
        await bench.amplifier.disarm(0.0)


@driving(_CAPS)
async def every_slot(bench: Bench) -> None:
    """It keeps an envelope in each of its slots, whatever becomes of the others."""
    step = step_of(bench)
    slots = range(1, bench.can.envelope_slots + 1)
    for slot in slots:
        await _shape(bench, slot, step, 0.5)
    await bench.arm()
    await _expect_kept(bench, slots, why="once all are loaded")
    for emptied in dict.fromkeys((slots[0], slots[len(slots) // 2], slots[-1])):
        await load(bench, emptied)
        others = [slot for slot in slots if slot != emptied]
        await _expect_kept(bench, others, why=f"once slot {emptied} was emptied")
        await bench.refused(_use(bench, [emptied, *others]), what=f"a set of slot {emptied}, empty")
        await load(bench, emptied, 0.5)


async def _expect_kept(bench: Bench, slots: Sequence[int], *, why: str) -> None:
    """Require that sets may refer to slots."""
    each = 2 * bench.can.channels
    for first in range(0, len(slots), each):
        used = list(slots[first : first + each])
        try:
            await _use(bench, used)
        except CommandRefused as refused:
            raise ContractViolation(
                f"a set of slots {used}, {why}", expected="a reply", seen=str(refused)
            ) from None
        await bench.beat()


async def _use(bench: Bench, slots: list[int]) -> None:
    """Stage a set, or apply one at level 0, that refers to slots, two for each channel."""
    pairs = [(*slots[at : at + 2], 0)[:2] for at in range(0, len(slots), 2)]
    level = bench.level / 2 if bench.has(Feature.STAGING) else 0.0
    commands = tuple(
        DriveCommand(channel, bench.frequency, level, onset=onset, ending=ending)
        for channel, (onset, ending) in enumerate(pairs[: bench.can.channels])
    )
    # A guard of its own, which knows of no set before, and holds no slot for empty.
    guard = bench.guard_as(bench.can)
    for slot in slots:
        guard.check_envelope(_of(bench, slot, step_of(bench), 0.5))
    token = bench.amplifier.next_token()
    command_set = CommandSet(token, commands, ramp=0.0, valid_for=0.0)
    requested = guard.check(command_set)
    if bench.has(Feature.STAGING):
        await bench.amplifier.stage(requested)
    else:
        await bench.apply(requested)


def _set_of(
    bench: Bench, commands: tuple[DriveCommand, ...], *, ramp: float = 0.0
) -> SafeCommandSet:
    token = bench.amplifier.next_token()
    return bench.guard.check(CommandSet(token, commands, ramp=ramp, valid_for=0.0))


@driving(_PLACE)
async def onset_of_another_frequency(bench: Bench) -> None:
    """It begins an onset with keep phase at zero if another frequency plays."""
    step, level = step_of(bench), bench.level
    other = _other_frequency(bench)
    await load(bench, 1, 0.5)
    await bench.arm()
    await bench.play(1.0)
    when = await bench.apply(bench.tones(1.0, onset=1, keep_phase=True, frequency=other))
    samples = await samples_until(bench, when.latest + 2.2 * step)
    rising = along(step, 0.0, 0.5 * level, level)
    after = [one for one in samples if one.when.earliest > when.latest + 0.002]
    what = "of an onset with keep phase at another frequency"
    expect_curve(bench, after, rising, commit=when, lasts=2 * step, what=what)


def _other_frequency(bench: Bench) -> float:
    limits = bench.guard.limits
    above, below = bench.frequency + 1.0, bench.frequency - 1.0
    if above <= limits.frequency_max:
        return above
    if below >= limits.frequency_min:
        return below
    raise NotApplicable("its range of frequencies is too narrow for two of them")


@driving("wire-protocol.md#sets-tokens-and-ramps", _PLACE)
async def phases_of_every_channel(bench: Bench) -> None:
    """It plays each channel at the phase of its command, also with keep phase."""
    bench.require(Feature.PHASE)
    step, level, can = step_of(bench), bench.level, bench.can
    channels = range(can.channels)
    for keep_phase in (False, True):
        for first in channels[: can.envelope_slots]:
            # A voice at the phase of a knot goes straight to it, and through lower levels else.
            await _load_phase(bench, first + 1, step, _phase_of(first))
        await bench.arm()
        if keep_phase:
            await bench.play(*(1.0,) * can.channels)
        await bench.apply(_phased(bench, keep_phase=keep_phase, ramp=bench.ramp))
        await bench.wait(1.1 * bench.ramp)
        when = await bench.apply(_phased(bench, keep_phase=True, shaped=True))
        samples = await samples_until(bench, when.latest + 2.2 * step)
        rising = along(step, level, _KEPT_PHASE_KNOT * level, level)
        how = "kept" if keep_phase else "new"
        for channel in channels[: can.envelope_slots]:
            what = f"of an onset at the {how} phase of {_phase_of(channel):g} degrees"
            expect_curve(
                bench, samples, rising, commit=when, lasts=2 * step, channel=channel, what=what
            )
        await bench.amplifier.disarm(0.0)


def _phase_of(channel: int) -> float:
    return _PHASES[channel % len(_PHASES)]


async def _load_phase(bench: Bench, slot: int, step: float, phase: float) -> None:
    """Load an envelope of one knot at a phase [degrees]."""
    knot = Knot(_KEPT_PHASE_KNOT * bench.level, -180.0 if phase == 180.0 else phase)
    await bench.amplifier.load_envelope(bench.guard.check_envelope(Envelope(slot, step, (knot,))))


def _phased(
    bench: Bench, *, keep_phase: bool, ramp: float = 0.0, shaped: bool = False
) -> SafeCommandSet:
    """Make a set of every channel at a phase of its own; shaped: by the onset of its slot."""
    commands = tuple(
        DriveCommand(
            channel,
            bench.frequency,
            bench.level,
            _phase_of(channel),
            keep_phase=keep_phase,
            onset=channel + 1 if shaped and channel < bench.can.envelope_slots else 0,
        )
        for channel in range(bench.can.channels)
    )
    return _set_of(bench, commands, ramp=ramp)

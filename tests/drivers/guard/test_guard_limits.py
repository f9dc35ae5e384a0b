"""The guard's limits beyond one command: slew, power, on-time, duty, rate, envelopes."""

import math
from collections.abc import Callable
from dataclasses import replace

import pytest

from drivers.command import CommandSet, DriveCommand, Envelope, Knot
from drivers.errors import CommandError, CommandRefused
from drivers.guard import Guard, GuardLimits, SafeCommandSet, SafeEnvelope
from drivers.protocol.messages import Capabilities, ChannelLimits, Feature

CAPABILITIES = Capabilities(
    *(4, 20.0, 600.0, 0.01, 1.0, 0.0001, 0.01, 1.0, 0.1, 2.0, 32, 16, 0.001, 0.1),
    features=Feature.WHOLE,
)


class Clock:
    """Time that a test sets."""

    def __init__(self) -> None:
        self.now = 100.0

    def __call__(self) -> float:
        return self.now


def guard(clock: Clock | None = None, **limits: float) -> Guard:
    """A guard with these limits beside 40 to 500 Hz and level 0.8."""
    return Guard(GuardLimits(40.0, 500.0, 0.8, **limits), CAPABILITIES, clock=clock or Clock())


def play(guard: Guard, wanted: CommandSet) -> SafeCommandSet:
    """Check a set, and record that it was sent and is confirmed at once."""
    safe = guard.check(wanted)
    safe.record.send(safe)
    safe.record.confirm(safe.token)
    return safe


def playing(
    token: int, *levels: float, ramp: float = 0.0, valid_for: float = 0.0, **more: int
) -> CommandSet:
    """A set at 110 Hz, a level a channel from 0 on."""
    commands = tuple(
        DriveCommand(channel, 110.0, level, **more) for channel, level in enumerate(levels)
    )
    return CommandSet(token, commands, ramp=ramp, valid_for=valid_for)


def tone(
    token: int, level: float, *, ramp: float, frequency: float = 110.0, **more: float
) -> CommandSet:
    """A set that continues the tone of channel 0 if it has this frequency."""
    valid_for = more.get("valid_for", 0.0)
    command = DriveCommand(0, frequency, level, more.get("phase", 0.0), keep_phase=True)
    return CommandSet(token, (command,), ramp=ramp, valid_for=valid_for)


def test_slew_limits_the_rise_of_a_level() -> None:
    """At 10 a second 0.5 takes 50 ms; falling and staying cost nothing; a new tone starts anew."""
    clock = Clock()
    strict = guard(clock, slew=10.0)
    for ramp in (0.0, 0.049):
        with pytest.raises(CommandRefused, match="longer ramp"):
            strict.check(tone(1, 0.5, ramp=ramp))
    assert strict.check(tone(2, 0.1234, ramp=0.01234)).ramp == 0.013  # as the wire can say it
    play(strict, tone(2, 0.5, ramp=0.05))
    clock.now += 1.0
    play(strict, tone(3, 0.6, ramp=0.01))
    clock.now += 1.0
    play(strict, tone(4, 0.1, ramp=0.0))
    with pytest.raises(CommandRefused, match="rise"):
        strict.check(tone(5, 0.1, ramp=0.005, frequency=200.0))
    assert strict.silence(6, [0], ramp=0.0).is_silent


Events = Callable[[Clock, Guard], None]


def interrupted_ramp(clock: Clock, strict: Guard) -> None:
    """10 ms of a ramp to 0.8 that takes a second."""
    play(strict, tone(1, 0.8, ramp=1.0))
    clock.now += 0.01


def ended_by_itself(clock: Clock, strict: Guard) -> None:
    """A vibration whose valid_for is over."""
    play(strict, tone(1, 0.8, ramp=0.1, valid_for=0.5))
    clock.now += 1.0


def about_to_end(clock: Clock, strict: Guard) -> None:
    """A vibration whose valid_for ends while the next set is on its way."""
    play(strict, tone(1, 0.8, ramp=0.1, valid_for=0.5))
    clock.now += 0.45


def stopped_and_armed(clock: Clock, strict: Guard) -> None:
    """A stop, clear and arm."""
    safe = play(strict, tone(1, 0.8, ramp=0.1))
    clock.now += 1.0
    safe.record.silence_sent()
    safe.record.silenced(0.005)


def unconfirmed_stop(clock: Clock, strict: Guard) -> None:
    """A stop without a reply, which may have arrived."""
    safe = play(strict, tone(1, 0.8, ramp=0.1))
    clock.now += 1.0
    safe.record.silence_sent()


def unconfirmed_set(clock: Clock, strict: Guard) -> None:
    """A set that was refused or superseded, and may not have arrived."""
    safe = strict.check(tone(1, 0.8, ramp=0.1))
    safe.record.send(safe)
    clock.now += 1.0


def unconfirmed_silence(clock: Clock, strict: Guard) -> None:
    """A silent set without a reply."""
    safe = play(strict, tone(1, 0.8, ramp=0.1))
    clock.now += 1.0
    silent = strict.silence(2, [0], ramp=0.01)
    safe.record.send(silent)


def only_checked(clock: Clock, strict: Guard) -> None:
    """A set that was checked and never sent."""
    strict.check(tone(1, 0.8, ramp=0.1))
    clock.now += 1.0


def other_phase(clock: Clock, strict: Guard) -> None:
    """A tone of opposite phase, through which the level passes zero."""
    play(strict, tone(1, 0.8, ramp=0.1, phase=180.0))
    clock.now += 1.0


@pytest.mark.parametrize(
    "events",
    [
        interrupted_ramp,
        ended_by_itself,
        about_to_end,
        stopped_and_armed,
        unconfirmed_stop,
        unconfirmed_set,
        unconfirmed_silence,
        only_checked,
        other_phase,
    ],
)
def test_slew_counts_from_the_lowest_level_that_may_play(events: Events) -> None:
    """A tone at 0.8 may not play although it was checked: reaching 0.8 again takes its ramp."""
    clock = Clock()
    strict = guard(clock, slew=10.0)
    events(clock, strict)
    for ramp in (0.0, 0.079):
        with pytest.raises(CommandRefused, match="rise") as caught:
            strict.check(tone(9, 0.8, ramp=ramp))
        assert caught.value.channel == 0
    strict.check(tone(9, 0.8, ramp=0.2))


def test_refusal_while_a_tone_fades_says_until_when() -> None:
    """Once the ramp has ended the level need not rise."""
    clock = Clock()
    strict = guard(clock, slew=10.0)
    play(strict, tone(1, 0.8, ramp=1.0))
    begin = clock.now
    clock.now += 0.5
    with pytest.raises(CommandRefused) as caught:
        strict.check(tone(2, 0.8, ramp=0.0))
    assert caught.value.until == begin + 1.0
    clock.now = caught.value.until
    strict.check(tone(2, 0.8, ramp=0.0))


def test_set_is_checked_again_when_it_is_sent() -> None:
    """Between its check and its sending another set changed what plays."""
    clock = Clock()
    strict = guard(clock, slew=10.0)
    play(strict, tone(1, 0.8, ramp=0.1))
    clock.now += 1.0
    held = strict.check(tone(2, 0.8, ramp=0.0))
    play(strict, tone(3, 0.1, ramp=0.1))
    clock.now += 1.0
    with pytest.raises(CommandRefused, match="rise"):
        held.record.send(held)


def test_envelope_over_a_fading_tone_keeps_level_and_power() -> None:
    """Along one ramp the sum stays below both; an envelope does not wait for the fade."""
    clock = Clock()
    for limits in ({}, {"power": 0.7}):
        strict = guard(clock, **limits)
        strict.check_envelope(Envelope(1, 0.01, (Knot(0.5, 0.0),)))
        play(strict, tone(1, 0.8, ramp=0.0))
        clock.now += 1.0
        strict.check(tone(2, 0.8, ramp=1.0, frequency=200.0))
        shaped = DriveCommand(0, 200.0, 0.5, onset=1)
        for is_sent in (False, True):  # a silent set before it may not have arrived
            if is_sent:
                silent = strict.silence(3, [0], ramp=0.0)
                silent.record.send(silent)
            with pytest.raises(CommandRefused, match="fade"):
                strict.check(CommandSet(4, (shaped,), ramp=1.0, valid_for=0.0))


def test_power_counts_tones_that_fade_below_envelopes() -> None:
    """On two channels 0.3 fades below a knot of 0.4: 2 (0.3 + 0.4)² = 0.98, each level allowed."""
    shaped = CommandSet(
        2,
        tuple(DriveCommand(channel, 200.0, 0.4, onset=1) for channel in (0, 1)),
        ramp=1.0,
        valid_for=0.0,
    )
    for power, is_allowed in ((0.99, True), (0.97, False)):
        strict = guard(power=power)
        strict.check_envelope(Envelope(1, 0.01, (Knot(0.4, 0.0),)))
        play(strict, playing(1, 0.3, 0.3))
        if is_allowed:
            strict.check(shaped)
        else:
            with pytest.raises(CommandRefused) as caught:
                strict.check(shaped)
            assert caught.value.channel is None  # not a level of its own


def test_slew_limits_the_rise_of_knots() -> None:
    """Within an envelope, from its start, and from its last knot to the command's level."""
    strict = guard(slew=10.0)
    with pytest.raises(CommandRefused, match=r"slot 1: .*0\.2"):
        strict.check_envelope(Envelope(1, 0.01, (Knot(0.1, 0.0), Knot(0.3, 0.0))))
    strict.check_envelope(Envelope(1, 0.01, (Knot(0.1, 0.0), Knot(0.2, 0.0))))
    strict.check(playing(1, 0.3, onset=1))
    with pytest.raises(CommandRefused, match="rise"):
        strict.check(playing(2, 0.31, onset=1))
    strict.check_envelope(Envelope(2, 0.01, (Knot(0.2, 0.0),)))
    with pytest.raises(CommandRefused, match="rise"):
        strict.check(playing(3, 0.2, onset=2))


def test_power_limits_the_squared_levels() -> None:
    """Squares of the levels add up; those of envelopes count where they are higher."""
    strict = guard(power=0.5)
    strict.check(playing(1, 0.5, 0.5))
    with pytest.raises(CommandRefused, match=r"0\.5, got 0\.75"):
        strict.check(playing(2, 0.5, 0.5, 0.5))
    strict.check_envelope(Envelope(1, 0.01, (Knot(0.8, 0.0),)))
    for which in ("onset", "ending"):
        with pytest.raises(CommandRefused, match="squared levels"):
            strict.check(playing(3, 0.1, **{which: 1}))


def test_protocol_bounds_reported_capabilities() -> None:
    """One that claims 40 channels and ramps of 5 s: at most 16, and 1 s, as the protocol has it."""
    boasting = replace(CAPABILITIES, channels=40, ramp_max=5.0)
    wide = Guard(GuardLimits(40.0, 500.0, 0.8), boasting, clock=Clock())
    last = CommandSet(1, (DriveCommand(15, 110.0, 0.5),), ramp=1.0, valid_for=0.0)
    assert wide.check(last).ramp == 1.0
    with pytest.raises(CommandRefused, match="0 to 15"):
        wide.check(replace(last, commands=(DriveCommand(16, 110.0, 0.5),)))
    with pytest.raises(CommandRefused, match="ramp"):
        wide.check(replace(last, ramp=1.001))
    assert wide.silence(2, range(40), ramp=5.0).ramp == 1.0


DELAY = 0.25  # s; from a check until the set plays, while another one does


def test_bounded_on_time_needs_an_amplifier_that_ends_vibrations() -> None:
    """Nothing else would end them in time; without such limits only valid_for is refused."""
    plain = replace(CAPABILITIES, features=Feature.WHOLE & ~Feature.VALID_FOR)
    for limits in ({"on_time": 5.0}, {"duty": 0.5}):
        with pytest.raises(CommandError, match="valid_for"):
            Guard(GuardLimits(40.0, 500.0, 0.8, **limits), plain)
    unlimited = Guard(GuardLimits(40.0, 500.0, 0.8), plain)
    commands = (DriveCommand(0, 110.0, 0.5),)
    assert unlimited.check(CommandSet(1, commands, ramp=0.0, valid_for=0.0)).valid_for == 0.0
    with pytest.raises(CommandRefused, match="valid_for"):
        unlimited.check(CommandSet(2, commands, ramp=0.0, valid_for=0.1))


def test_amplifier_of_voltages_is_refused() -> None:
    """Limits of stroke would mean something else there."""
    volts = replace(CAPABILITIES, features=Feature.WHOLE | Feature.VOLTAGE)
    with pytest.raises(CommandError, match="full stroke"):
        Guard(GuardLimits(40.0, 500.0, 0.8), volts)


def test_channels_bound_the_limits_of_all() -> None:
    """The highest of the lowest frequencies, the lowest of the rest: a pattern needs them all."""
    limits = (ChannelLimits(50.0, 600.0, 0.9), ChannelLimits(20.0, 300.0, 0.6)) * 2
    bounded = Guard(
        GuardLimits(40.0, 500.0, 0.8), replace(CAPABILITIES, channel_limits=limits)
    ).limits
    assert (bounded.frequency_min, bounded.frequency_max, bounded.level) == (50.0, 300.0, 0.6)
    disjoint = (ChannelLimits(20.0, 90.0, 1.0), ChannelLimits(100.0, 600.0, 1.0)) * 2
    with pytest.raises(CommandError, match="frequency range"):
        Guard(GuardLimits(40.0, 500.0, 0.8), replace(CAPABILITIES, channel_limits=disjoint))


def test_on_time_shortens_valid_for() -> None:
    """2 s without a pause: the set ends by itself by then, its ramp included."""
    clock = Clock()
    strict = guard(clock, on_time=2.0)
    assert strict.check(playing(1, 0.5, ramp=0.5)).valid_for == 1.5
    assert play(strict, playing(1, 0.5)).valid_for == 2.0
    clock.now += 0.5
    assert play(strict, playing(2, 0.5)).valid_for == 1.5 - DELAY
    clock.now += 0.5
    assert strict.check(playing(3, 0.5)).valid_for == 1.0 - DELAY
    assert strict.check(playing(3, 0.5, valid_for=0.25)).valid_for == 0.25
    clock.now += 0.74
    assert strict.check(playing(3, 0.5)).valid_for == pytest.approx(0.01)
    clock.now += 0.0095
    with pytest.raises(CommandRefused, match="on-time"):  # less than the wire can say
        strict.check(playing(3, 0.5))
    play(strict, playing(4, 0.0))
    clock.now += 0.001
    assert play(strict, playing(5, 0.5)).valid_for == 2.0
    clock.now += 3.0  # it has ended by itself
    assert strict.check(playing(6, 0.5)).valid_for == 2.0


def test_silence_is_shortened_to_the_time_left() -> None:
    """0.15 s before the end of the on-time, 0.1 s of which it may be on its way."""
    clock = Clock()
    strict = guard(clock, on_time=2.0)
    play(strict, playing(1, 0.5, ramp=0.0))
    clock.now += 1.85
    assert strict.silence(2, [0], ramp=0.5).ramp == pytest.approx(0.05, abs=0.001)
    assert strict.check(playing(2, 0.0, ramp=0.5)).ramp == pytest.approx(0.05, abs=0.001)


def test_unconfirmed_silence_does_not_end_the_on_time() -> None:
    """It may not have arrived."""
    clock = Clock()
    strict = guard(clock, on_time=2.0)
    play(strict, playing(1, 0.5))
    clock.now += 1.0
    silent = strict.silence(2, [0], ramp=0.0)
    silent.record.send(silent)
    clock.now += 0.5
    assert strict.check(playing(3, 0.5)).valid_for == 0.5 - DELAY


def test_set_checked_too_long_ago_is_not_sent() -> None:
    """Its valid_for would exceed the on-time that is left."""
    clock = Clock()
    strict = guard(clock, on_time=2.0)
    play(strict, playing(1, 0.5))
    held = strict.check(playing(2, 0.5))
    clock.now += 0.2
    with pytest.raises(CommandRefused, match="check it again"):
        held.record.send(held)


def test_valid_for_is_bounded_by_the_wire() -> None:
    """At most the 60 s that it can say, and never rounded to 0, which is without end."""
    assert guard(on_time=3600.0).check(playing(1, 0.5)).valid_for == 60.0
    assert guard().check(playing(1, 0.5, valid_for=1e-5)).valid_for == 0.001


def test_onset_to_silence_counts_as_vibration() -> None:
    """An ERA that helps at an onset only: its time counts, as that of a level does."""
    clock = Clock()
    strict = guard(clock, on_time=2.0, rate=2.0)
    strict.check_envelope(Envelope(1, 0.01, (Knot(0.1, 0.0),)))
    assert play(strict, playing(1, 0.0, onset=1)).valid_for == 2.0
    clock.now += 0.5
    assert play(strict, playing(2, 0.0, onset=1)).valid_for == 1.5 - DELAY
    with pytest.raises(CommandRefused, match="a second"):
        strict.check(playing(3, 0.0, onset=1))


def test_duty_limits_the_vibration_time() -> None:
    """A tenth of ten seconds: 1 s, then a rest until the window has moved on."""
    clock = Clock()
    strict = guard(clock, duty=0.1)
    assert play(strict, playing(1, 0.5, valid_for=0.4)).valid_for == 0.4
    clock.now += 0.5  # it ended 0.1 s ago
    assert play(strict, playing(2, 0.5)).valid_for == pytest.approx(0.6, abs=0.002)
    clock.now += 0.7
    with pytest.raises(CommandRefused, match="duty"):
        strict.check(playing(3, 0.5))
    assert strict.check(playing(3, 0.0)).is_silent
    clock.now += 9.0
    # Of the last ten seconds it vibrated 0.2 s of the first set and 0.6 s of the second.
    assert strict.check(playing(4, 0.5)).valid_for == pytest.approx(0.2, abs=0.002)
    clock.now += 20.0
    assert strict.check(playing(5, 0.5)).valid_for == pytest.approx(1.0)


def test_rate_limits_sets_per_second() -> None:
    """Ten within any second, also if some are delayed by 0.1 s; silence is not counted."""
    clock = Clock()
    strict = guard(clock, rate=10.0)
    begin = clock.now
    for token in range(1, 11):
        for _ in range(3):  # checks count nothing
            strict.check(playing(token, 0.5))
        play(strict, playing(token, 0.5))
        clock.now += 0.01
    with pytest.raises(CommandRefused, match="10 command sets") as caught:
        strict.check(playing(11, 0.5))
    assert caught.value.until == pytest.approx(begin + 1.1)
    assert play(strict, playing(12, 0.0)).is_silent
    clock.now = caught.value.until
    play(strict, playing(13, 0.5))
    with pytest.raises(CommandRefused, match="a second"):
        strict.check(playing(14, 0.5))


def test_valid_for_is_unchanged_without_limits() -> None:
    """A set that lasts until the next stays one."""
    assert guard().check(playing(1, 0.5)).valid_for == 0.0


@pytest.mark.parametrize("name", ["slew", "power", "on_time", "duty", "rate"])
@pytest.mark.parametrize("value", [0.0, -1.0, math.nan])
def test_limits_that_leave_nothing_are_refused(name: str, value: float) -> None:
    """A limit of zero, below, or no number is a mistake of the configuration."""
    with pytest.raises(CommandError, match=name):
        guard(**{name: value})


@pytest.mark.parametrize(
    ("envelope", "problem"),
    [
        (Envelope(0, 0.005, (Knot(0.1, 0.0),)), "slot .*1 to 16"),
        (Envelope(17, 0.005, (Knot(0.1, 0.0),)), "slot .*1 to 16"),
        (Envelope(1, 0.0, (Knot(0.1, 0.0),)), "step"),
        (Envelope(1, math.nan, (Knot(0.1, 0.0),)), "step"),
        (Envelope(1, 0.005, (Knot(0.1, 0.0),) * 33), "33 knots"),
        (Envelope(1, 0.005, (Knot(0.1, 0.0), Knot(0.81, 0.0))), "knot 1"),
        (Envelope(1, 0.005, (Knot(math.nan, 0.0),)), "knot 0"),
        (Envelope(1, 0.005, (Knot(0.1, math.inf),)), "knot 0"),
    ],
)
def test_envelope_out_of_range_is_refused(envelope: Envelope, problem: str) -> None:
    """Slot, step, number of knots, and every knot's level and phase."""
    with pytest.raises(CommandRefused, match=problem):
        guard().check_envelope(envelope)


def test_set_must_refer_to_loaded_slots() -> None:
    """What is in a slot decides about slew and power, so it must be known; until it is emptied."""
    known = guard()
    with pytest.raises(CommandRefused, match="empty slot 3"):
        known.check(playing(1, 0.5, ending=3))
    known.check_envelope(Envelope(3, 0.005, (Knot(0.1, 0.0),)))
    known.check(playing(2, 0.5, ending=3))
    known.check_envelope(Envelope(3, 0.005, ()))
    with pytest.raises(CommandRefused, match="empty slot 3"):
        known.check(playing(3, 0.5, ending=3))


def test_settled_after_covers_ramps_and_envelopes() -> None:
    """The ramp, or the longest envelope that may play, each a step longer than its knots."""
    known = guard()
    assert known.check(playing(1, 0.5, ramp=0.02)).settled_after == 0.02
    known.check_envelope(Envelope(3, 0.01, (Knot(0.1, 0.0),) * 4))
    assert known.check(playing(2, 0.5, ramp=0.02)).settled_after == pytest.approx(0.05)
    assert known.silence(3, [0], ramp=0.01).settled_after == 0.01


def test_safe_types_cannot_be_made_or_subclassed() -> None:
    """Neither can be made by hand, nor be derived from."""
    with pytest.raises(TypeError):
        SafeEnvelope(1, 0.005, ())
    for kind in (SafeCommandSet, SafeEnvelope):
        with pytest.raises(TypeError):
            type("Sly", (kind,), {})

"""The guard's limits beyond one command: slew, power, on-time, duty, rate, envelopes."""

import math
from dataclasses import replace

import pytest

from drivers.command import CommandSet, DriveCommand, Envelope, Knot
from drivers.errors import CommandError, CommandRefused
from drivers.guard import Guard, GuardLimits, SafeCommandSet, SafeEnvelope
from drivers.protocol.messages import Capabilities

CAPABILITIES = Capabilities(
    *(4, 20.0, 600.0, 0.01, 1.0, 0.0001, 0.01, 1.0, 0.1, 2.0, 32, 16, 0.001, 0.1, False)
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


def playing(
    token: int, *levels: float, ramp: float = 0.0, valid_for: float = 0.0, **more: int
) -> CommandSet:
    """A set at 110 Hz, a level a channel from 0 on."""
    commands = tuple(
        DriveCommand(channel, 110.0, level, **more) for channel, level in enumerate(levels)
    )
    return CommandSet(token, commands, ramp=ramp, valid_for=valid_for)


def test_slew_limits_the_rise_of_a_level() -> None:
    """At 10 a second, 0.5 takes 50 ms; falling and staying cost nothing; a new tone starts anew."""
    strict = guard(slew=10.0)
    for ramp in (0.0, 0.049):
        with pytest.raises(CommandRefused, match=r"0\.5 .*longer ramp"):
            strict.check(playing(1, 0.5, ramp=ramp))
    strict.check(playing(2, 0.5, ramp=0.05))
    strict.check(playing(3, 0.6, ramp=0.01))
    strict.check(playing(4, 0.1, ramp=0.0))
    other = CommandSet(5, (DriveCommand(0, 200.0, 0.1),), ramp=0.005, valid_for=0.0)
    with pytest.raises(CommandRefused, match="rise"):
        strict.check(other)
    assert strict.silence(6, [0], ramp=0.0).is_silent


def test_slew_limits_the_rise_of_knots() -> None:
    """Within an envelope, from its begin, and from its last knot to the command's level."""
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


def test_on_time_shortens_valid_for() -> None:
    """2 s without a pause: the set ends by itself by then, and the next one comes too late."""
    clock = Clock()
    strict = guard(clock, on_time=2.0)
    assert strict.check(playing(1, 0.5)).valid_for == 2.0
    clock.now += 1.5
    assert strict.check(playing(2, 0.5)).valid_for == 0.5
    assert strict.check(playing(3, 0.5, valid_for=0.25)).valid_for == 0.25
    clock.now += 0.2
    strict.silence(4, [0], ramp=0.0)
    assert strict.check(playing(5, 0.5)).valid_for == 2.0
    clock.now += 1.999
    strict.check(playing(6, 0.5))
    clock.now += 1.0  # it has ended by itself
    assert strict.check(playing(7, 0.5)).valid_for == 2.0


def test_on_time_counts_from_the_begin_of_a_vibration() -> None:
    """Of 2 s of on-time, a set every half second leaves half a second less each time."""
    clock = Clock()
    strict = guard(clock, on_time=2.0)
    for token, left in enumerate((2.0, 1.5, 1.0, 0.5), start=1):
        assert strict.check(playing(token, 0.5)).valid_for == pytest.approx(left)
        clock.now += 0.5


def test_valid_for_is_bounded_by_the_protocol() -> None:
    """With an hour of on-time it ends after the 60 s that a wire can say, and is to be renewed."""
    assert guard(on_time=3600.0).check(playing(1, 0.5)).valid_for == 60.0


def test_onset_to_silence_counts_as_vibration() -> None:
    """An ERA that helps at an onset only: its time counts, as that of a level does."""
    clock = Clock()
    strict = guard(clock, on_time=2.0, rate=2.0)
    strict.check_envelope(Envelope(1, 0.01, (Knot(0.1, 0.0),)))
    assert strict.check(playing(1, 0.0, onset=1)).valid_for == 2.0
    clock.now += 0.5
    assert strict.check(playing(2, 0.0, onset=1)).valid_for == 1.5
    strict.check(playing(3, 0.5))
    with pytest.raises(CommandRefused, match="a second"):
        strict.check(playing(4, 0.0, onset=1))


def test_ended_vibration_counts_until_its_end() -> None:
    """Of 2 s in ten, one second is used by a set that ended by itself, seen late."""
    clock = Clock()
    strict = guard(clock, duty=0.2)
    strict.check(playing(1, 0.5, valid_for=1.0))
    clock.now += 5.0
    assert strict.check(playing(2, 0.5)).valid_for == pytest.approx(1.0)


def test_duty_limits_the_vibration_time() -> None:
    """A tenth of ten seconds: 1 s, then a rest until the window has moved on."""
    clock = Clock()
    strict = guard(clock, duty=0.1)
    assert strict.check(playing(1, 0.5)).valid_for == pytest.approx(1.0)
    clock.now += 0.4
    assert strict.check(playing(1, 0.5)).valid_for == pytest.approx(0.6)
    clock.now += 0.6
    with pytest.raises(CommandRefused, match="duty"):
        strict.check(playing(2, 0.5))
    assert strict.check(playing(3, 0.0)).is_silent
    clock.now += 9.5
    assert strict.check(playing(4, 0.5)).valid_for == pytest.approx(0.5)
    clock.now += 20.0
    assert strict.check(playing(5, 0.5)).valid_for == pytest.approx(1.0)


def test_rate_limits_sets_per_second() -> None:
    """Ten a second: ten at once are let through, the eleventh not, one more after 0.1 s."""
    clock = Clock()
    strict = guard(clock, rate=10.0)
    for token in range(1, 11):
        strict.check(playing(token, 0.5))
    with pytest.raises(CommandRefused, match="10 command sets") as caught:
        strict.check(playing(11, 0.5))
    assert caught.value.until == pytest.approx(clock.now + 0.1)
    assert strict.check(playing(12, 0.0)).is_silent
    clock.now += 0.1001
    strict.check(playing(13, 0.5))
    with pytest.raises(CommandRefused, match="a second") as caught:
        strict.check(playing(14, 0.5))
    assert caught.value.until is not None
    clock.now = caught.value.until
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

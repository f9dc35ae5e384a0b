import copy
import math
import re
from dataclasses import replace

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from drivers.codec.serial_line.exchanges import decode_request, encode_request
from drivers.command import CommandSet, DriveCommand
from drivers.errors import CommandError, CommandRefused
from drivers.guard import Guard, GuardLimits, SafeCommandSet
from drivers.protocol.messages import Apply, Capabilities, Feature

CAPABILITIES = Capabilities(
    *(4, 20.0, 600.0, 0.01, 1.0, 0.0001, 0.01, 0.5, 0.1, 2.0, 0), features=Feature.WHOLE
)
GUARD = Guard(GuardLimits(40.0, 500.0, 0.8), CAPABILITIES)
GOOD = CommandSet(token=7, commands=(DriveCommand(1, 110.0, 0.5, 30.0),), ramp=0.02, valid_for=1.0)


def with_command(**changes: object) -> CommandSet:
    """The good set with its one command changed."""
    return replace(GOOD, commands=(replace(GOOD.commands[0], **changes),))


def test_guard_passes_a_valid_set_unchanged() -> None:
    """Within the limits."""
    safe = GUARD.check(GOOD)
    assert type(safe) is SafeCommandSet
    assert (safe.token, safe.commands) == (GOOD.token, GOOD.commands)
    assert (safe.ramp, safe.valid_for) == (GOOD.ramp, GOOD.valid_for)


@pytest.mark.parametrize(
    ("bad", "reason"),
    [
        *[
            (with_command(**{name: value}), f"{name} of channel 1")
            for name in ("frequency", "level", "phase")
            for value in (math.nan, math.inf, -math.inf, "1", None)
        ],
        (with_command(frequency=39.99), "frequency of channel 1.*39.99 Hz"),
        (with_command(frequency=500.01), "40 to 500 Hz"),
        (with_command(level=-0.01), "level of channel 1"),
        (with_command(level=0.81), "0 to 0.8"),
        (with_command(channel=4), "channel must be .* got 4"),
        (with_command(channel=-1), "channel must be .* got -1"),
        (with_command(channel=1.5), "channel must be .* got 1.5"),
        (replace(GOOD, commands=GOOD.commands * 2), "channel 1.*twice"),
        *[(replace(GOOD, token=token), "token") for token in (0, -1, 65536, 1.0, None)],
        *[(replace(GOOD, ramp=ramp), "ramp") for ramp in (-0.001, 0.501, math.nan, math.inf)],
        *[(replace(GOOD, valid_for=value), "valid_for") for value in (-1, 60.1, math.nan)],
    ],
)
def test_guard_refuses_an_invalid_set(bad: CommandSet, reason: str) -> None:
    """Each bad value is refused with its channel and reason, and is silence for the loop."""
    with pytest.raises(CommandRefused, match=reason):
        GUARD.check(bad)
    safe, why = GUARD.check_or_silence(bad, ramp=0.01)
    assert why is not None
    assert re.search(reason, str(why))
    assert safe.is_silent
    assert [command.channel for command in safe.commands] == [0, 1, 2, 3]


def test_refusal_has_the_channel() -> None:
    """CommandRefused carries the channel to blame."""
    with pytest.raises(CommandRefused) as caught:
        GUARD.check(with_command(level=2.0))
    assert caught.value.channel == 1


NUMBERS = st.one_of(st.floats(), st.integers(), st.none(), st.text(max_size=3))


@settings(max_examples=20)
@given(
    st.builds(
        CommandSet,
        token=NUMBERS,
        commands=st.lists(
            st.builds(DriveCommand, NUMBERS, NUMBERS, NUMBERS, NUMBERS, st.booleans()), max_size=5
        ).map(tuple),
        ramp=NUMBERS,
        valid_for=NUMBERS,
    )
    | st.none(),
    NUMBERS,
)
def test_check_or_silence_always_returns_a_safe_set(wanted: CommandSet, ramp: float) -> None:
    """Any garbage becomes a set that can be encoded and that keeps every limit."""
    safe, reason = GUARD.check_or_silence(wanted, ramp=ramp)
    sent = decode_request(encode_request(Apply(safe), address=1, sequence=1))
    assert isinstance(sent, Apply)
    for command in sent.command_set.commands:
        assert 0 <= command.channel <= 3
        assert 0 <= command.level <= 0.8
        assert 40 <= command.frequency <= 500
    assert sent.command_set.ramp <= 0.5
    assert reason is None or safe.is_silent


def test_check_or_silence_turns_any_exception_into_silence() -> None:
    """An exception of any kind inside a set becomes silence too."""

    class Broken(CommandSet):
        @property
        def commands(self) -> tuple[DriveCommand, ...]:
            raise ZeroDivisionError("broken")

    broken = object.__new__(Broken)
    for name in ("token", "ramp", "valid_for"):
        object.__setattr__(broken, name, getattr(GOOD, name))
    safe, reason = GUARD.check_or_silence(broken, ramp=0.01)
    assert safe.is_silent
    assert str(reason) == "ZeroDivisionError: broken"


def test_silence_takes_a_new_token() -> None:
    """A token that was played already would make the amplifier ignore the silence."""
    for last, following in ((41, 42), (65535, 1)):
        safe = GUARD.check(replace(GOOD, token=last))
        safe.record.send(safe)
        assert GUARD.silence(0, [0], ramp=0.01).token == following


def test_silent_channel_may_have_any_frequency() -> None:
    """At level zero the frequency does not matter, and none is sent that could be refused."""
    safe = GUARD.check(with_command(level=0.0, frequency=0.0))
    assert safe.commands[0].frequency == 40.0


@pytest.mark.parametrize(
    ("limits", "capabilities", "expected"),
    [
        (GuardLimits(1.0, 1000.0, 2.0), {}, GuardLimits(20.0, 600.0, 1.0)),
        (GuardLimits(1.0, 1000.0, 2.0), {"level_max": 0.3}, GuardLimits(20.0, 600.0, 0.3)),
        (
            GuardLimits(1.0, 5000.0, 2.0),
            {"frequency_min": 1.0, "frequency_max": 4000.0, "level_max": 5.0},
            GuardLimits(10.0, 3276.75, 1.0),
        ),
        (GuardLimits(40.0, 500.0, 0.8), {}, GuardLimits(40.0, 500.0, 0.8)),
    ],
)
def test_limits_in_force_are_the_least(
    limits: GuardLimits, capabilities: dict[str, float], expected: GuardLimits
) -> None:
    """Configuration, amplifier and the built-in ceiling: the tightest of the three holds."""
    in_force = Guard(limits, replace(CAPABILITIES, **capabilities)).limits
    assert in_force == replace(expected, rate=2000.0)


@pytest.mark.parametrize(
    "limits",
    [
        GuardLimits(500.0, 40.0, 1.0),
        GuardLimits(700.0, 800.0, 1.0),
        GuardLimits(math.nan, 500.0, 1.0),
        GuardLimits(40.0, 500.0, -0.1),
    ],
)
def test_limits_that_leave_nothing_are_refused(limits: GuardLimits) -> None:
    """A guard without a playable frequency or level is a mistake in the configuration."""
    with pytest.raises(CommandError):
        Guard(limits, CAPABILITIES)


def test_only_the_guard_makes_safe_sets() -> None:
    """Neither the constructor nor a changed copy nor a subclass gets past the guard."""
    safe = GUARD.check(GOOD)
    with pytest.raises(TypeError):
        SafeCommandSet(1, (), ramp=0.0, valid_for=0.0)
    with pytest.raises(TypeError):
        replace(safe, token=8)
    with pytest.raises(TypeError):
        type("Forged", (SafeCommandSet,), {})
    with pytest.raises(AttributeError):
        safe.token = 8
    assert copy.copy(safe) == safe

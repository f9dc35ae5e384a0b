"""The rules about a single set that a host sends: token, limits, and what the touch asks for."""

import math
from collections.abc import Mapping

from sim.witness.amplifier_session import AmplifierSession
from sim.witness.decoded import ChannelCommand, Request

_STEP = 0.6  # of a step of the wire: what rounding may make

ExpectedSets = Mapping[str, Mapping[int, tuple[float, float, float]]]
"""What a touch should give, by amplifier and channel: Hz, level, degrees."""


def check_set(
    session: AmplifierSession, time: float, request: Request, expected: ExpectedSets | None
) -> None:
    """Its token, its limits, and that it is what is expected, where anything is."""
    _check_token(session, time, request)
    for channel, command in request.commands.items():
        if command.vibrates:
            _check_limits(session, time, channel, command, request.ramp)
    if request.vibrates and expected is not None:
        _check_expected(session, time, request, expected)


def check_shape(session: AmplifierSession, time: float, level: float) -> None:
    """An envelope that goes to this level is within the limits of some channel."""
    highest = max((limits.level for limits in session.config.channels.values()), default=0.0)
    if level > highest + 1e-4 * _STEP:
        session.report(
            "limits",
            time,
            f"an envelope of {session.name} goes to level {level:g}; allowed is {highest:g}",
        )


def _check_token(session: AmplifierSession, time: float, request: Request) -> None:
    for place, (token, other) in enumerate(session.tokens):
        is_last = place == len(session.tokens) - 1
        if token == request.token and not (is_last and other.commands == request.commands):
            session.report(
                "token",
                time,
                f"set {token} is sent to {session.name} again "
                + ("with other contents" if is_last else "after others"),
            )
            return
    if not any(token == request.token for token, _ in session.tokens):
        session.tokens.append((request.token, request))


def _check_limits(
    session: AmplifierSession, time: float, channel: int, command: ChannelCommand, ramp: float
) -> None:
    limits = session.config.channels.get(channel)
    what = (
        f"channel {channel} of {session.name} is told {command.frequency:g} Hz at {command.level:g}"
    )
    if limits is None:
        session.report("limits", time, f"{what}, but there is no such channel")
        return
    fine = 0.01 * _STEP
    if not limits.frequency_min - fine <= command.frequency <= limits.frequency_max + fine:
        session.report(
            "limits",
            time,
            f"{what}; allowed are {limits.frequency_min:g} to {limits.frequency_max:g} Hz",
        )
    if command.level > limits.level + 1e-4 * _STEP:
        session.report("limits", time, f"{what}; allowed is a level of {limits.level:g}")
    before = session.levels.get(channel)
    goes_on = before is not None and before.frequency == command.frequency
    rise = command.level - (before.level if before is not None and goes_on else 0.0)
    if not command.onset and rise > limits.slew * ramp + 1e-4 * _STEP:
        session.report(
            "limits", time, f"{what} within {ramp:g} s; allowed is {limits.slew:g} a second"
        )


def _check_expected(
    session: AmplifierSession, time: float, request: Request, expected: ExpectedSets
) -> None:
    wanted = expected.get(session.name, {})
    told = {
        channel: (command.frequency, command.level, command.phase)
        for channel, command in request.commands.items()
        if command.vibrates
    }
    same = told.keys() == wanted.keys() and all(
        abs(told[channel][0] - frequency) < 0.01 * _STEP
        and abs(told[channel][1] - level) < 1e-4 * _STEP
        and abs(math.remainder(told[channel][2] - phase, 360.0)) < 0.01 * _STEP
        for channel, (frequency, level, phase) in wanted.items()
    )
    if not same:
        session.report(
            "pattern",
            time,
            f"{session.name} is told {_listed(told)}; the touch asks for {_listed(wanted)}",
        )


def _listed(channels: Mapping[int, tuple[float, float, float]]) -> str:
    return (
        ", ".join(
            f"{channel}: {frequency:g} Hz {level:g} {phase:g} degrees"
            for channel, (frequency, level, phase) in sorted(channels.items())
        )
        or "nothing"
    )

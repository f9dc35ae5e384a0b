"""Rules for one set that a host sends: token, limits and expected pattern."""

import math
from collections.abc import Mapping

from sim.witness.amplifier_session import AmplifierSession
from sim.witness.decoded import ChannelCommand, Request, RequestKind
from sim.witness.quantities import is_newer

_STEP = 0.6  # of a step of the wire; tolerance of rounding

ExpectedSets = Mapping[str, Mapping[int, tuple[float, float, float]]]
"""Expected frequency [Hz], level and phase [deg] by amplifier and channel."""


def check_set(
    session: AmplifierSession, time: float, request: Request, expected: ExpectedSets | None
) -> None:
    """Check token, limits and, where it is given, the expected pattern."""
    _check_token(session, time, request)
    for channel, command in request.commands.items():
        if command.vibrates:
            _check_limits(session, time, channel, command, request.ramp)
    if request.vibrates and expected is not None:
        _check_expected(session, time, request, expected)


def check_envelope(session: AmplifierSession, time: float, level: float) -> None:
    """Check the highest level of an envelope against the limits of the channels."""
    highest = max((limits.level for limits in session.config.channels.values()), default=0.0)
    if level > highest + 1e-4 * _STEP:
        session.report(
            "limits",
            time,
            f"{session.name}: envelope level must be at most {highest:g}, got {level:g}",
        )


def _check_token(session: AmplifierSession, time: float, request: Request) -> None:
    active = session.active_set
    is_repeated = active is not None and (request.token, request.commands) == (
        active.token,
        active.commands,
    )
    if is_repeated and request.kind is RequestKind.APPLY:
        return  # its reply may have been lost, also if another set is staged meanwhile
    last, session.last_set = session.last_set, request
    if last is None or is_newer(request.token, last.token):
        return
    if request.token != last.token or request.commands != last.commands:
        session.report(
            "token",
            time,
            f"set {request.token} sent to {session.name} after set {last.token}"
            + (" with other contents" if request.token == last.token else ""),
        )


def _check_limits(
    session: AmplifierSession, time: float, channel: int, command: ChannelCommand, ramp: float
) -> None:
    limits = session.config.channels.get(channel)
    what = f"channel {channel} of {session.name} set to {command.frequency:g} Hz, {command.level:g}"
    if limits is None:
        session.report("limits", time, f"{what}: no such channel")
        return
    fine = 0.01 * _STEP
    low, high = limits.frequency_hz
    if not low - fine <= command.frequency <= high + fine:
        session.report(
            "limits",
            time,
            f"{what}; frequency must be {low:g} to {high:g} Hz",
        )
    if command.level > limits.level + 1e-4 * _STEP:
        session.report("limits", time, f"{what}; level must be at most {limits.level:g}")
    before = session.levels.get(channel)
    continues = before is not None and before.frequency == command.frequency
    rise = command.level - (before.level if before is not None and continues else 0.0)
    if not command.onset and rise > limits.slew_per_s * ramp + 1e-4 * _STEP:
        session.report(
            "limits",
            time,
            f"{what} within {ramp:g} s; slew must be at most {limits.slew_per_s:g} 1/s",
        )


def _check_expected(
    session: AmplifierSession, time: float, request: Request, expected: ExpectedSets
) -> None:
    wanted = expected.get(session.name, {})
    sent = {
        channel: (command.frequency, command.level, command.phase)
        for channel, command in request.commands.items()
        if command.vibrates
    }
    same = sent.keys() == wanted.keys() and all(
        abs(sent[channel][0] - frequency) < 0.01 * _STEP
        and abs(sent[channel][1] - level) < 1e-4 * _STEP
        and abs(math.remainder(sent[channel][2] - phase, 360.0)) < 0.01 * _STEP
        for channel, (frequency, level, phase) in wanted.items()
    )
    if not same:
        session.report(
            "pattern",
            time,
            f"{session.name} commanded {_listed(sent)}, expected {_listed(wanted)}",
        )


def _listed(channels: Mapping[int, tuple[float, float, float]]) -> str:
    return (
        ", ".join(
            f"{channel}: {frequency:g} Hz {level:g} {phase:g} degrees"
            for channel, (frequency, level, phase) in sorted(channels.items())
        )
        or "nothing"
    )

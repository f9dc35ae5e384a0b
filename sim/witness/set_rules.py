"""The rules about a single set that a host sends: token, limits, and what the touch asks for."""

import math
from collections.abc import Mapping

from sim.witness.seen import Asked, Drive
from sim.witness.side import Side

_STEP = 0.6  # of a step of the wire: what rounding may make

Expected = Mapping[str, Mapping[int, tuple[float, float, float]]]
"""What a touch should give, by amplifier and channel: Hz, level, degrees."""


def check_set(side: Side, time: float, asked: Asked, expected: Expected | None) -> None:
    """Its token, its limits, and that it is what is expected, where anything is."""
    _check_token(side, time, asked)
    for channel, drive in asked.drives.items():
        if drive.vibrates:
            _check_limits(side, time, channel, drive, asked.ramp)
    if asked.vibrates and expected is not None:
        _check_expected(side, time, asked, expected)


def check_shape(side: Side, time: float, level: float) -> None:
    """An envelope that goes to this level is within the limits of some channel."""
    highest = max((limits.level for limits in side.plan.channels.values()), default=0.0)
    if level > highest + 1e-4 * _STEP:
        side.complain(
            "limits",
            time,
            f"an envelope of {side.name} goes to level {level:g}; allowed is {highest:g}",
        )


def _check_token(side: Side, time: float, asked: Asked) -> None:
    for place, (token, other) in enumerate(side.tokens):
        is_last = place == len(side.tokens) - 1
        if token == asked.token and not (is_last and other.drives == asked.drives):
            side.complain(
                "token",
                time,
                f"set {token} is sent to {side.name} again "
                + ("with other contents" if is_last else "after others"),
            )
            return
    if not any(token == asked.token for token, _ in side.tokens):
        side.tokens.append((asked.token, asked))


def _check_limits(side: Side, time: float, channel: int, drive: Drive, ramp: float) -> None:
    limits = side.plan.channels.get(channel)
    what = f"channel {channel} of {side.name} is told {drive.frequency:g} Hz at {drive.level:g}"
    if limits is None:
        side.complain("limits", time, f"{what}, but there is no such channel")
        return
    fine = 0.01 * _STEP
    if not limits.frequency_min - fine <= drive.frequency <= limits.frequency_max + fine:
        side.complain(
            "limits",
            time,
            f"{what}; allowed are {limits.frequency_min:g} to {limits.frequency_max:g} Hz",
        )
    if drive.level > limits.level + 1e-4 * _STEP:
        side.complain("limits", time, f"{what}; allowed is a level of {limits.level:g}")
    before = side.levels.get(channel)
    goes_on = before is not None and before.frequency == drive.frequency
    rise = drive.level - (before.level if before is not None and goes_on else 0.0)
    if not drive.onset and rise > limits.slew * ramp + 1e-4 * _STEP:
        side.complain(
            "limits", time, f"{what} within {ramp:g} s; allowed is {limits.slew:g} a second"
        )


def _check_expected(side: Side, time: float, asked: Asked, expected: Expected) -> None:
    wanted = expected.get(side.name, {})
    told = {
        channel: (drive.frequency, drive.level, drive.phase)
        for channel, drive in asked.drives.items()
        if drive.vibrates
    }
    same = told.keys() == wanted.keys() and all(
        abs(told[channel][0] - frequency) < 0.01 * _STEP
        and abs(told[channel][1] - level) < 1e-4 * _STEP
        and abs(math.remainder(told[channel][2] - phase, 360.0)) < 0.01 * _STEP
        for channel, (frequency, level, phase) in wanted.items()
    )
    if not same:
        side.complain(
            "pattern",
            time,
            f"{side.name} is told {_listed(told)}; the touch asks for {_listed(wanted)}",
        )


def _listed(channels: Mapping[int, tuple[float, float, float]]) -> str:
    return (
        ", ".join(
            f"{channel}: {frequency:g} Hz {level:g} {phase:g} degrees"
            for channel, (frequency, level, phase) in sorted(channels.items())
        )
        or "nothing"
    )

"""Rules for one set that a host sends: token, limits and expected pattern."""

import math
from collections.abc import Mapping, Sequence
from copy import deepcopy
from dataclasses import replace
from typing import TypeAlias

from drivers.protocol.sets import Command, LayerSet, is_newer_token
from drivers.protocol.table import QUANTITIES
from sim.witness.amplifier_session import AmplifierSession

_STEP = 0.6  # of a step of the wire; tolerance of rounding
_ABOVE = 1.01  # of a sum; what it may exceed a limit by, for moments that are not known
_FREQUENCY, _LEVEL, _PHASE = (QUANTITIES[name] for name in ("frequency", "level", "phase"))

Tone: TypeAlias = tuple[float, float, float]
ExpectedSets = Mapping[str, Mapping[int, Sequence[Tone]]]
"""Expected tones by amplifier and channel, over all layers: frequency [Hz], level, phase [deg]."""


def check_set(
    session: AmplifierSession, time: float, token: int, layers: Sequence[LayerSet]
) -> None:
    """Check token and limits of a set that is sent."""
    last = session.last_set or (0, ())
    session.staged = session.last_set = (token, layers)
    is_same = session.staged == last
    if last[0] and not is_same and not is_newer_token(token, last[0]):
        other = " with other contents" if token == last[0] else ""
        session.report_always(
            "token", time, f"set {token} sent to {session.name} after set {last[0]}{other}"
        )
    count = session.amplifier.capabilities.get("layers", math.inf)
    for one in layers:
        if one.layer >= count:
            session.report_always(
                "limits", time, f"set {token}: {session.name} has no layer {one.layer}"
            )
        for command in one.commands:
            if command.is_driven and (problem := _problem_of(session, command)):
                session.report_always(
                    "limits", time, f"channel {command.channel} of {session.name}: {problem}"
                )


def _problem_of(session: AmplifierSession, command: Command) -> str:
    """Describe which limit of its channel a command breaks; "" for none."""
    limits = session.config.channels.get(command.channel)
    if limits is None:
        return "no such channel"
    frequency, (low, high) = _FREQUENCY.from_wire(command.frequency), limits.frequency_hz
    if not low - _FREQUENCY.step * _STEP <= frequency <= high + _FREQUENCY.step * _STEP:
        return f"frequency must be {low:g} to {high:g} Hz, got {frequency:g}"
    shapes = [shape for shape in (command.onset, command.ending) if shape is not None]
    level = max(command.level, *(level for shape in shapes for level, _ in shape.knots), 0)
    if _LEVEL.from_wire(level) > limits.level + _LEVEL.step * _STEP:
        return f"level must be at most {limits.level:g}, got {_LEVEL.from_wire(level):g}"
    return ""


def check_sums(session: AmplifierSession, time: float) -> None:
    """Check what an amplifier plays from a time on, over all layers."""
    levels, power, rises = session.amplifier.outputs.sums(time)
    checked = [("power", power, session.config.power)]
    for channel, limits in session.config.channels.items():
        name = f"channel {channel}, sum of all layers"
        checked.append((f"level of {name}", levels.get(channel, 0.0), limits.level))
        checked.append((f"rise of {name}", rises.get(channel, 0.0), limits.slew_per_s))
    for what, value, limit in checked:
        if value > limit * _ABOVE + _LEVEL.step:
            session.report_always(
                "limits", time, f"{session.name}: {what} must be at most {limit:g}, got {value:.4g}"
            )


def check_expected(
    session: AmplifierSession,
    time: float,
    layers: Sequence[LayerSet],
    expected: ExpectedSets,
) -> None:
    """Compare what all layers play once a set is committed with the expected pattern."""
    after = deepcopy(session.played)
    after.commit([replace(one, after=False) for one in layers], 1, time)
    sent: dict[int, list[Tone]] = {}
    for layer in after.tokens:
        for command in after.playing(layer).commands:
            sent.setdefault(command.channel, []).append(
                (
                    _FREQUENCY.from_wire(command.frequency),
                    _LEVEL.from_wire(command.level),
                    _PHASE.from_wire(command.phase),
                )
            )
    must = {channel: tones for channel, tones in expected.get(session.name, {}).items() if tones}
    same = sent.keys() == must.keys() and all(
        len(sent[channel]) == len(tones)
        and all(any(_is_same(tone, other) for other in sent[channel]) for tone in tones)
        for channel, tones in must.items()
    )
    if not same:
        session.report_always(
            "pattern",
            time,
            f"{session.name} commanded {sent}, expected {must}: Hz, levels, degrees by channel",
        )


def _is_same(one: Tone, other: Tone) -> bool:
    return (
        abs(one[0] - other[0]) < _FREQUENCY.step * _STEP
        and abs(one[1] - other[1]) < _LEVEL.step * _STEP
        and abs(math.remainder(one[2] - other[2], 360.0)) < _PHASE.step * _STEP
    )

"""Rules for one set that a host sends: token, limits and expected pattern."""

import math
from collections.abc import Mapping, Sequence

from drivers.protocol.sets import Command, LayerSet
from drivers.protocol.table import QUANTITIES
from drivers.protocol.tokens import is_newer_token
from sim.witness.amplifier_session import AmplifierSession, is_vibrating

_STEP = 0.6  # of a step of the wire; tolerance of rounding
_ABOVE = 1.01  # of a sum; what it may exceed a limit by, for moments that are not known
_FREQUENCY, _LEVEL, _PHASE = (QUANTITIES[name] for name in ("frequency", "level", "phase"))

Tones = Mapping[int, Sequence[tuple[float, float, float]]]
ExpectedSets = Mapping[str, Tones]
"""Expected tones by amplifier and channel, over all layers: frequency [Hz], level, phase [deg]."""


def check_set(
    session: AmplifierSession, time: float, token: int, layers: Sequence[LayerSet]
) -> None:
    """Check token and limits of a set that is sent."""
    last = session.last_set or (0, ())
    session.staged = session.last_set = (token, tuple(layers))
    is_same = session.staged == last
    if last[0] and not is_same and not is_newer_token(token, last[0]):
        other = " with other contents" if token == last[0] else ""
        what = f"set {token} sent to {session.name} after set {last[0]}{other}"
        session.report("token", time, what)
    can = session.amplifier.capabilities
    for one in layers:
        if can and one.layer >= can["layers"]:
            what = f"set {token}: layer {one.layer} of {session.name}: no such layer"
            session.report("limits", time, what)
        for command in one.commands:
            if command.is_driven:
                _check_limits(session, time, command)


def _check_limits(session: AmplifierSession, time: float, command: Command) -> None:
    limits = session.config.channels.get(command.channel)
    frequency, level = _FREQUENCY.from_wire(command.frequency), _LEVEL.from_wire(command.level)
    what = f"channel {command.channel} of {session.name} set to {frequency:g} Hz, {level:g}"
    if limits is None:
        session.report("limits", time, f"{what}: no such channel")
        return
    low, high = limits.frequency_hz
    if not low - _FREQUENCY.step * _STEP <= frequency <= high + _FREQUENCY.step * _STEP:
        problem = f"{what}; frequency must be {low:g} to {high:g} Hz"
        session.report("limits", time, problem)
    shapes = [shape for shape in (command.onset, command.ending) if shape is not None]
    knots = [_LEVEL.from_wire(knot) for shape in shapes for knot, _ in shape.knots]
    highest = max((level, *knots))
    if highest > limits.level + _LEVEL.step * _STEP:
        problem = f"{what}, up to {highest:g}; level must be at most {limits.level:g}"
        session.report("limits", time, problem)


def check_sums(session: AmplifierSession, time: float) -> None:
    """Check what an amplifier plays from a time on, over all layers."""
    levels, power, rises = session.amplifier.outputs.sums(time)
    for channel, limits in session.config.channels.items():
        what = f"channel {channel} of {session.name}: sum of all layers"
        level, rise = levels.get(channel, 0.0), rises.get(channel, 0.0)
        if level > limits.level * _ABOVE + _LEVEL.step:
            problem = f"{what} must be at most {limits.level:g}, got {level:.4f}"
            session.report("limits", time, problem)
        if rise > limits.slew_per_s * _ABOVE + _LEVEL.step:
            problem = f"{what} must rise by at most {limits.slew_per_s:g} 1/s, got {rise:.4g}"
            session.report("limits", time, problem)
    if power > session.config.power * _ABOVE + _LEVEL.step:
        problem = f"{session.name}: power must be at most {session.config.power:g}, got {power:.4f}"
        session.report("limits", time, problem)


def check_expected(
    session: AmplifierSession,
    time: float,
    layers: Sequence[LayerSet],
    expected: ExpectedSets,
) -> None:
    """Compare what all layers play once a set is committed with the expected pattern."""
    if not is_vibrating(layers):
        return
    after = {number: one for number, (one, until) in session.layers.items() if until > time}
    after.update({one.layer: one for one in layers if not one.renew})
    sent: dict[int, list[tuple[float, float, float]]] = {}
    for one in after.values():
        for command in one.commands:
            if command.is_driven:
                tone = (
                    _FREQUENCY.from_wire(command.frequency),
                    _LEVEL.from_wire(command.level),
                    _PHASE.from_wire(command.phase),
                )
                sent.setdefault(command.channel, []).append(tone)
    must = {channel: tones for channel, tones in expected.get(session.name, {}).items() if tones}
    same = sent.keys() == must.keys() and all(
        len(sent[channel]) == len(tones)
        and all(any(_is_same(tone, other) for other in sent[channel]) for tone in tones)
        for channel, tones in must.items()
    )
    if not same:
        what = f"{session.name} commanded {_listed(sent)}, expected {_listed(must)}"
        session.report("pattern", time, what)


def _is_same(one: tuple[float, float, float], other: tuple[float, float, float]) -> bool:
    return (
        abs(one[0] - other[0]) < _FREQUENCY.step * _STEP
        and abs(one[1] - other[1]) < _LEVEL.step * _STEP
        and abs(math.remainder(one[2] - other[2], 360.0)) < _PHASE.step * _STEP
    )


def _listed(channels: Tones) -> str:
    tones = (
        f"{channel}: {frequency:g} Hz {level:g} {phase:g} degrees"
        for channel, several in sorted(channels.items())
        for frequency, level, phase in several
    )
    return ", ".join(tones) or "nothing"

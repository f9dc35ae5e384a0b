"""Achieved playback: the reply to GetAchieved, compared with the layer that was sent.

All numbers are wire integers. An amplifier rounds frequencies, levels and phases to its own steps.
"""

from dataclasses import replace
from typing import NamedTuple

from drivers.protocol.records import Values
from drivers.protocol.sets import Command, LayerSet

TONE = "frequency", "level", "phase"
FLAGS = "after", "renew", "keep_phase", "skip_ending", "onset", "ending"
"""Fields of layers and commands that GetAchieved does not have."""
_TURN = 36_000  # wire units; phases are modulo this
_DERATED = 0.01  # tolerance of the ratios in a derated set


class AchievedProblem(NamedTuple):
    """A value in a reply to GetAchieved that contradicts the layer."""

    rule: str
    """The broken rule: plays, commit or token."""
    quantity: str
    required: object
    received: object


def achieved_problem(
    layer: LayerSet,
    reply: Values,
    capabilities: Values,
    *,
    is_exact: bool,
    can_scale: bool = False,
    slack: float = 0.0,
) -> AchievedProblem | None:
    """Describe an error in a layer's achieved playback; None if it is within half a step.

    is_exact: whether all values must be equal. can_scale: whether all levels can be lower by a
    common factor. slack: tolerance in steps of the wire, in addition to the steps of the amplifier.
    """
    achieved = {tone["channel"]: tone for tone in reply["commands"]}
    other_channels = achieved.keys() - {command.channel for command in layer.commands}
    if other_channels:
        quantity = "channels that are not driven"
        return AchievedProblem("commit", quantity, "none", sorted(other_channels))
    names = ("layer", "ramp") if achieved else ("layer",)
    required = [getattr(layer, name) for name in names]
    received = [reply[name] for name in names]
    if required != received:
        return AchievedProblem("plays", ", ".join(names), required, received)
    for command in layer.commands:
        tone = achieved.get(command.channel)
        for name in TONE if command.level else ("level",):  # silence has no phase
            allowed = 0.0
            if command.level and not is_exact:
                allowed = _rounding(name, command, capabilities) + slack
            error = _error(name, command, tone)
            is_scaled = can_scale and name == "level" and _level_of(tone) <= command.level
            if error > allowed and not is_scaled:
                quantity = f"error of achieved {name} of channel {command.channel}"
                rule = "commit" if tone is None else "plays"
                return AchievedProblem(rule, quantity, f"0 to {allowed:g}", error)
    return _scaling_problem(layer, achieved, capabilities) if can_scale else None


def _level_of(tone: Values | None) -> int:
    """Return the achieved level of a channel; 0 if the reply does not have the channel."""
    return 0 if tone is None else tone["level"]


def _error(name: str, command: Command, tone: Values | None) -> int:
    """Return the error of an achieved frequency, level or phase; tone: see `_level_of`."""
    required: int = getattr(command, name)
    if name == "level":
        return abs(_level_of(tone) - required)
    if tone is None:
        return 0
    error: int = abs(tone[name] - required)
    return min(error, _TURN - error) if name == "phase" else error


def _scaling_problem(
    layer: LayerSet, achieved: dict[int, Values], capabilities: Values
) -> AchievedProblem | None:
    """Describe levels that are not lowered by a common factor; achieved: tones by channel."""
    levels: list[int] = []
    ratios: list[float] = []
    for command in layer.commands:
        if command.level:
            levels.append(command.level)
            ratios.append(_level_of(achieved.get(command.channel)) / command.level)
    difference = max(ratios, default=0.0) - min(ratios, default=0.0)
    if difference > _DERATED + capabilities.get("level_step", 1) / min(levels, default=1):
        return AchievedProblem("commit", "shares of its channels", "alike", sorted(ratios))
    return None


def achieved_layer(layer: LayerSet, reply: Values, capabilities: Values) -> LayerSet:
    """Return a layer with the levels, frequencies and phases of a reply.

    A tone at level 0, possibly the target of an onset, stays unchanged if the reported frequency is
    not its rounded value: an amplifier can report any.
    """
    achieved = {tone["channel"]: tone for tone in reply["commands"]}
    commands = []
    for command in layer.commands:
        tone = achieved.get(command.channel)
        if tone is None:
            command = replace(command, level=0)
        elif command.level or _is_rounded(command, tone, capabilities):
            command = replace(command, **{name: tone[name] for name in TONE})
        commands.append(command)
    return replace(layer, commands=tuple(commands))


def _is_rounded(command: Command, tone: Values, capabilities: Values) -> bool:
    """Whether an achieved frequency is the rounded frequency of a command."""
    return _error("frequency", command, tone) <= int(capabilities["frequency_step"])


def _rounding(name: str, command: Command, capabilities: Values) -> float:
    """Return by how much a value of a command may be rounded: inwards at the limits."""
    step = capabilities.get(f"{name}_step", 1)
    if name != "phase" and capabilities:
        value = getattr(command, name)
        limits = capabilities["limits"][command.channel]
        low = limits.get(f"{name}_min", 0)
        high = limits[f"{name}_max"]
        if not low <= value - step / 2 <= value + step / 2 <= high:
            return float(step)
    return float(step / 2)

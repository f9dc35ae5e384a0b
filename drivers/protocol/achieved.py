"""What a layer plays by a GetAchieved, compared with what it must play: steps and shares."""

from dataclasses import replace
from typing import TypeAlias

from drivers.protocol.records import Values
from drivers.protocol.sets import Command, LayerSet

TONE = "frequency", "level", "phase"
FLAGS = "after", "renew", "keep_phase", "skip_ending", "onset", "ending"
"""Of layers and commands, which a GetAchieved does not have."""
Problem: TypeAlias = tuple[str, str, object, object]
"""A rule that is broken: what must be what, and what was seen."""
_TURN = 36_000  # of the wire; phases are modulo this
_DERATED = 0.01  # by which the shares of a derated set may differ


def achieved_problem(
    one: LayerSet,
    reply: Values,
    can: Values,
    *,
    is_exact: bool,
    can_scale: bool = False,
    slack: float = 0.0,
) -> Problem | None:
    """Return what is wrong with how a layer plays by a reply; None if it is within half a step.

    can: capabilities. is_exact: to the word; can_scale: all levels may be lower by one factor;
    slack: in steps of the wire, beside the steps of the amplifier.
    """
    found = {each["channel"]: each for each in reply["commands"]}
    shares: dict[int, float] = {}
    if beyond := found.keys() - {tone.channel for tone in one.commands}:
        return "commit", "channels that are not driven", "none", sorted(beyond)
    names = ("layer", "ramp") if found else ("layer",)
    must, seen = [getattr(one, name) for name in names], [reply[name] for name in names]
    if must != seen:
        return "plays", ", ".join(names), must, seen
    for tone in one.commands:
        requested = {name: getattr(tone, name) for name in TONE}
        got = found.get(tone.channel, {**requested, "level": 0})
        for name in TONE if tone.level else ("level",):  # silence has no phase
            error = abs(got[name] - requested[name])
            error = min(error, _TURN - error) if name == "phase" else error
            allowed = 0.0 if is_exact or not tone.level else _rounding(name, tone, can) + slack
            is_scaled = can_scale and name == "level" and got[name] <= requested[name]
            if error > allowed and not is_scaled:
                what = f"error of achieved {name} of channel {tone.channel}"
                rule = "plays" if tone.channel in found else "commit"
                return rule, what, f"0 to {allowed:g}", error
        if tone.level and can_scale:
            shares[tone.level] = got["level"] / tone.level
    apart = max(shares.values(), default=0.0) - min(shares.values(), default=0.0)
    if apart > _DERATED + can.get("level_step", 1) / min(shares, default=1):
        return "commit", "shares of its channels", "alike", sorted(shares.values())
    return None


def achieved_layer(one: LayerSet, reply: Values, can: Values) -> LayerSet:
    """Return a layer as it plays by a reply: other levels, frequencies and phases.

    can: capabilities. A tone at level 0, to which an onset may lead, stays as it is where its
    frequency is no rounding of it: an amplifier may say any.
    """
    found = {each["channel"]: {name: each[name] for name in TONE} for each in reply["commands"]}
    commands = []
    for tone in one.commands:
        got = found.get(tone.channel, {"level": 0})
        error = abs(got.get("frequency", tone.frequency) - tone.frequency)
        is_any = not tone.level and error > can["frequency_step"]
        commands.append(tone if is_any else replace(tone, **got))
    return replace(one, commands=tuple(commands))


def _rounding(name: str, tone: Command, can: Values) -> float:
    """Return by how much a part of a tone may be rounded: inwards at the limits."""
    step = can.get(f"{name}_step", 1)
    if name != "phase" and can:
        value, limits = getattr(tone, name), can["limits"][tone.channel]
        low, high = limits.get(f"{name}_min", 0), limits[f"{name}_max"]
        if not low <= value - step / 2 <= value + step / 2 <= high:
            return float(step)
    return float(step / 2)

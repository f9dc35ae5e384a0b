"""Keys of a rig file with the ERAs of a layout in place of the rig's own."""

from collections.abc import Mapping
from copy import deepcopy
from typing import Any

from model.arrays import FloatArray
from model.config.fields import section_by_kind
from model.design.problem import DesignProblem
from model.rig.actuator_keys import KINDS
from model.rig.rig import Channel, Rig

MAX_CHANNELS = 4
"""Channels of an amplifier beyond the rig's own ones."""


def layout_keys(
    problem: DesignProblem, positions: FloatArray, data: Mapping[str, Any]
) -> dict[str, Any]:
    """Data of a rig file with ERAs at positions [m], on free channels; data: of the rig's file.

    Amplifiers that are missing are added, simulated.
    """
    rig = problem.rig
    before, amplifiers = data["eras"], data["amplifiers"]
    channels = iter(_free_channels(rig, problem.kept, count=problem.count))
    eras: dict[str, Any] = {}
    mounts = rig.masses[len(rig.masses) - len(rig.supports) :]
    for name, mount in zip(rig.supports, mounts, strict=True):
        eras[name] = _damped(before[name], mount.damping)
    used = {}
    like = _damped(before[problem.like.name], problem.like.damping)
    if problem.stiffness is not None:
        for key in _instead_of("stiffness", like):
            like.pop(key, None)
        like["stiffness"] = problem.stiffness
    for era in problem.eras(positions):
        if era.name in problem.kept:
            eras[era.name] = _damped(before[era.name], era.damping)
            continue
        channel = next(channels)
        used[channel.amplifier] = True
        eras[era.name] = deepcopy(like) | {
            "at": [round(era.x, 6), round(era.y, 6)],
            "amplifier": channel.amplifier,
            "channel": channel.number,
        }
    own = {rig.wiring[name].amplifier for name in problem.kept}
    given = {name: amplifiers[name] for name in amplifiers if name in own or name in used}
    added = {name: {"url": "sim://"} for name in used if name not in amplifiers}
    return {**data, "eras": eras, "amplifiers": {**given, **added}}


def _damped(section: Mapping[str, Any], damping: float) -> dict[str, Any]:
    """A copy of an ERA's keys with its damping by itself: a ratio refers to the number of ERAs.

    And a quality of an exciter to its stiffness.
    """
    replaced = _instead_of("damping", section)
    keys = {key: value for key, value in deepcopy(section).items() if key not in replaced}
    return keys | {"damping": float(f"{damping:.6g}")}


def _instead_of(key: str, section: Mapping[str, Any]) -> tuple[str, ...]:
    """Keys that one replaces in an actuator of the section's kind."""
    return section_by_kind([*KINDS.values()], section).instead.get(key, ())


def _free_channels(rig: Rig, kept: tuple[str, ...], *, count: int) -> list[Channel]:
    """The rig's channels without those of kept ERAs, and further amplifiers of MAX_CHANNELS."""
    free = [channel for name, channel in rig.wiring.items() if name not in kept]
    names = (
        name for number in range(2, 99) if (name := f"amplifier{number}") not in rig.amplifiers
    )
    while len(free) < count:
        name = next(names)
        free += [Channel(name, number) for number in range(MAX_CHANNELS)]
    return free

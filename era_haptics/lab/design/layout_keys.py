"""Rig-file data of a layout: its ERAs on free channels, and amplifiers for them."""

from collections.abc import Mapping
from copy import deepcopy
from itertools import count as numbers_from
from typing import Any

from era_haptics.lab.design.problem import DesignProblem
from model.arrays import FloatArray
from model.config.fields import section_by_kind
from model.rig.actuator_keys import ACTUATOR_KINDS
from model.rig.rig import Channel, Rig

_MAX_CHANNELS = 4
"""Channels per added amplifier."""


def layout_keys(
    problem: DesignProblem, positions: FloatArray, data: Mapping[str, Any]
) -> dict[str, Any]:
    """Return rig-file data with ERAs at positions [m], on free channels; data: of the original rig
    file.

    Missing amplifiers are added as simulated ones.
    """
    rig = problem.rig
    sections = data["eras"]
    eras = _support_sections(rig, sections)
    template = _template_section(problem, sections)
    channels = iter(_free_channels(rig, problem.kept, count=len(positions)))
    amplifiers = {rig.wiring[name].amplifier for name in problem.kept}
    added_amplifiers: dict[str, Any] = {}
    for era in problem.eras(positions):
        if era.name in problem.kept:
            eras[era.name] = _damped(sections[era.name], era.damping)
            continue
        channel = next(channels)
        amplifiers.add(channel.amplifier)
        if channel.amplifier not in data["amplifiers"]:
            added_amplifiers[channel.amplifier] = {"url": "sim://"}
        eras[era.name] = {
            **deepcopy(template),
            "at": [round(era.x, 6), round(era.y, 6)],
            "amplifier": channel.amplifier,
            "channel": channel.number,
        }
    used_amplifiers = {
        name: section for name, section in data["amplifiers"].items() if name in amplifiers
    }
    return {**data, "eras": eras, "amplifiers": {**used_amplifiers, **added_amplifiers}}


def _support_sections(rig: Rig, sections: Mapping[str, Any]) -> dict[str, Any]:
    """Return the sections of the rig's mounts that are not driven."""
    mounts = rig.masses[len(rig.masses) - len(rig.supports) :]
    return {
        name: _damped(sections[name], mount.damping)
        for name, mount in zip(rig.supports, mounts, strict=True)
    }


def _template_section(problem: DesignProblem, sections: Mapping[str, Any]) -> dict[str, Any]:
    """Return the keys that new ERAs share."""
    template = _damped(sections[problem.like.name], problem.like.damping)
    if problem.stiffness is not None:
        for key in _instead_of("stiffness", template):
            template.pop(key, None)
        template["stiffness"] = problem.stiffness
    return template


def _damped(section: Mapping[str, Any], damping: float) -> dict[str, Any]:
    """Return an ERA's keys with absolute damping, since a ratio depends on the number of ERAs.

    For an exciter, Q is converted likewise, since it depends on the stiffness.
    """
    replaced = _instead_of("damping", section)
    keys = {key: value for key, value in deepcopy(section).items() if key not in replaced}
    keys["damping"] = float(f"{damping:.6g}")
    return keys


def _instead_of(key: str, section: Mapping[str, Any]) -> tuple[str, ...]:
    """Return the keys that `key` replaces in an actuator of the section's kind."""
    kind = section_by_kind([*ACTUATOR_KINDS.values()], section)
    return kind.instead.get(key, ())


def _free_channels(rig: Rig, kept: tuple[str, ...], *, count: int) -> list[Channel]:
    """Return the rig's channels except the ones of kept ERAs, then channels of added amplifiers."""
    channels = [channel for name, channel in rig.wiring.items() if name not in kept]
    for number in numbers_from(2):
        if len(channels) >= count:
            break
        name = f"amplifier{number}"
        if name not in rig.amplifiers:
            channels += [Channel(name, channel) for channel in range(_MAX_CHANNELS)]
    return channels

"""ERAs in a rig file: their keys, and the ERA that a section is."""

from collections.abc import Callable, Iterator, Set
from dataclasses import fields
from typing import Annotated, Any, Literal

from model.config.sections import Quantity
from model.config.units import DAMPING, LENGTH, MASS, RATIO, STIFFNESS
from model.rig.actuator_section import ActuatorSection
from model.rig.key_types import gains_of, place_on
from model.structure.attachments import Era, damping_from_ratio
from model.structure.plate import Plate

STIFF_MOUNT = 1e6
"""Stiffness [N/m] from which the dent of a point force in the plate counts beside the mount's own.

On the paper's plate a radius of 5 mm in place of a point changes the response by 2 % at 400 Hz and
16 % near a resonance (`docs/decisions/0049-stiff-mounts-have-a-size.md`).
"""

_SAME = {each.name for each in fields(Era)} - {"damping", "gains"}
"""Fields that have the values of the keys of their names."""


class EraSection(ActuatorSection):
    """One ERA; without an amplifier it only supports the plate.

    Defaults of damping and stroke are assumed, the paper prints neither.
    """

    kind: Literal["era"] = "era"
    """An ERA, unless it is an [exciter](#exciters)."""

    stiffness: Annotated[float, Quantity(STIFFNESS, above=0, at_most=1e12)]
    """Of its spring, k_b."""

    damping_ratio: Annotated[float, Quantity(RATIO, at_least=0, at_most=2)] = 0.05
    """Zeta of its damper: c = 2 zeta sqrt(k_b m / n), m the bare plate's mass, n the number of
    ERAs.
    """

    damping: Annotated[float, Quantity(DAMPING, at_least=0, at_most=1e6)] | None = None
    """C itself, instead of `damping_ratio`."""

    bolt_mass: Annotated[float, Quantity(MASS, at_least=0, at_most=10)] = 0.0
    """Mass that moves with the plate, m_b."""

    stroke: Annotated[float, Quantity(LENGTH, above=0, at_most=0.01)] = 100e-6
    """Amplitude of its base at level 1, where its gain is 1."""


def era_of(name: str, section: EraSection, plate: Plate, era_count: int) -> Era:
    """An ERA; era_count: of the rig, for the damping from a ratio."""
    damping = section.damping
    if damping is None:
        damping = damping_from_ratio(
            section.damping_ratio,
            stiffness=section.stiffness,
            plate_mass=plate.mass,
            era_count=era_count,
        )
    x, y = place_on(plate, section.at)
    same = section.model_dump(include=_SAME)
    return Era(name, x, y, damping=damping, gains=gains_of(section.gains), **same)


def era_problems(given: Set[str], read: Callable[[str], Any]) -> Iterator[tuple[str, str]]:
    """What keys of an ERA require of each other: problems by key."""
    if {"damping", "damping_ratio"} <= given:
        yield "damping", "must not be given with damping_ratio; remove one of the two"
    for key, other in (("amplifier", "channel"), ("channel", "amplifier")):
        if other in given and key not in given:
            yield key, f"missing; add it, or remove {other} too for an ERA that only supports"
    yield from stiff_mount_problems(given, read("stiffness"))


def stiff_mount_problems(given: Set[str], stiffness: float | None) -> Iterator[tuple[str, str]]:
    """The problem of a stiff mount [N/m] without a size, by key; none of others."""
    if stiffness is not None and stiffness >= STIFF_MOUNT and "foot" not in given:
        yield (
            "foot",
            f"missing; add the radius of the patch on which it holds the plate: at "
            f"{stiffness:g} N/m, {STIFF_MOUNT:g} N/m or more, the response depends on it",
        )

"""ERAs in a rig file: their keys, and the ERA that a section is."""

from collections.abc import Iterator, Mapping
from dataclasses import fields
from typing import Annotated, Any, ClassVar, Literal

from model.config.fields import DAMPING, LENGTH, MASS, RATIO, STIFFNESS, Quantity
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

    keys: ClassVar = {each: each for each in ("stiffness", "damping", "bolt_mass", "gains")}
    instead: ClassVar = {"damping": ("damping_ratio",)}

    def made(self, name: str, plate: Plate, count: int) -> Era:
        """An ERA; its damping from a ratio depends on plate and count."""
        by_ratio = damping_from_ratio(
            self.damping_ratio, stiffness=self.stiffness, plate_mass=plate.mass, era_count=count
        )
        damping = by_ratio if self.damping is None else self.damping
        at, same = place_on(plate, self.at), self.model_dump(include=_SAME)
        return Era(name, *at, damping=damping, gains=gains_of(self.gains), **same)

    @classmethod
    def problems(cls, given: Mapping[str, Any]) -> Iterator[tuple[str, str]]:
        """Damping in two ways, half of a wiring, and a stiff mount without a size."""
        if {"damping", "damping_ratio"} <= given.keys():
            yield "damping", "must not be given with damping_ratio; remove one of the two"
        for key, other in (("amplifier", "channel"), ("channel", "amplifier")):
            if other in given and key not in given:
                yield key, f"missing; add it, or remove {other} too for an ERA that only supports"
        yield from stiff_mount_problems(given)


def stiff_mount_problems(given: Mapping[str, Any]) -> Iterator[tuple[str, str]]:
    """The problem of a stiff mount without a size, by key; none of others. given: as `problems`."""
    stiffness = given.get("stiffness")
    if stiffness is not None and stiffness >= STIFF_MOUNT and "foot" not in given:
        yield (
            "foot",
            f"missing; add the radius of the patch on which it holds the plate: at "
            f"{stiffness:g} N/m, {STIFF_MOUNT:g} N/m or more, the response depends on it",
        )

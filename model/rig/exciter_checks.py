"""What the exciters of a rig can follow: from which frequency on, and what its file may mean."""

import math
from collections.abc import Iterator
from dataclasses import dataclass
from pkgutil import resolve_name

import numpy as np
from numpy.typing import NDArray

from model.arrays import FloatArray
from model.config.document import Document
from model.rig.exciter_section import ExciterSection, misread_resonance, rated_power
from model.rig.rig import Rig
from model.structure.exciter import Exciter
from model.structure.support import GRAVITY

_EXCURSIONS = "model.transients.excursions:excursions_of"
"""By name: it solves plates, which the packages above this one do."""

_NEARLY = 1.001
_LAG = 0.01  # (omega L / R)² from which time and frequency differ visibly
_ABOVE = 1.3  # times the resonance of a magnet, where little depends on it


@dataclass(frozen=True, eq=False)
class Excursions:
    """Excursions [m] of each exciter at the rig's level, (n,).

    at_lowest: settled at its lowest frequency; largest: in onsets within all that it allows, of
    those that are limited; passed (n,): whether these are more than they may be; allowed: the
    lowest frequency [Hz] from which all stay within up to the highest, infinite where they do not
    there.
    """

    at_lowest: FloatArray
    largest: FloatArray
    passed: NDArray[np.bool_]
    allowed: float


def exciters_of(rig: Rig) -> list[Exciter]:
    """The exciters among its actuators."""
    return [era for era in rig.eras if isinstance(era, Exciter)]


def excursion_notes(rig: Rig) -> list[str]:
    """A warning where full level would move magnets beyond their excursion."""
    exciters, limits = exciters_of(rig), rig.limits
    if not exciters:
        return []
    found: Excursions = resolve_name(_EXCURSIONS)(rig)
    if not found.passed.any():
        return []
    shares = found.largest / [one.excursion for one in exciters]
    worst = int(shares.argmax())
    names = ", ".join(
        one.name for one, is_far in zip(exciters, found.passed, strict=True) if is_far
    )
    lowest = (
        f"within from {found.allowed:g} Hz on" if np.isfinite(found.allowed) else "nowhere within"
    )
    return [
        f"limits.frequency: from {limits.frequency_min:g} Hz on limits.level {limits.level:g} can "
        f"move the magnets of {names} beyond their excursion, that of {exciters[worst].name} by "
        f"{1e3 * found.largest[worst]:.2g} mm of {1e3 * exciters[worst].excursion:.2g} mm ({lowest}"
        "); answers play less there, tones by hand do not: a level of at most "
        f"{math.floor(1e3 * limits.level / shares[worst]) / 1e3:g} is safe"
    ]


def exciter_notes(document: Document, rig: Rig) -> list[str]:
    """Warnings: resonances that may be misread, and magnets that move too far or resonate.

    Of a resonance that may be misread it is not said from where on to play.
    """
    low, high = rig.limits.frequency_min, rig.limits.frequency_max
    misread: dict[str, list[str]] = {}
    hazards: list[str] = []
    for one in exciters_of(rig):
        section = ExciterSection.model_validate(document.value(("eras", one.name)))
        if said := misread_resonance(section):
            misread.setdefault(said, []).append(one.name)
        hazards += [f"eras.{one.name}.{each}" for each in _hazards(one, section, rig)]
    notes = [f"resonance_is of {', '.join(names)}: {said}" for said, names in misread.items()]
    notes += [*hazards, *excursion_notes(rig)]
    doubted = {name for names in misread.values() for name in names}
    free = [one for one in exciters_of(rig) if not one.held and one.name not in doubted]
    near = [one for one in free if low < _ABOVE * one.magnet_frequency]
    if near:
        highest = max(one.magnet_frequency for one in near)
        start = math.ceil(_ABOVE * highest)
        advice = f"start at {start} Hz, or identify the rig" if start < high else "identify the rig"
        notes.append(
            f"limits.frequency: starts at {low:g} Hz, below {_ABOVE:g} times the resonance of the "
            f"magnets of {', '.join(one.name for one in near)} at up to {highest:.1f} Hz, where "
            f"the field depends on suspension and weight as much as on the plate; {advice}"
        )
    return notes


def _hazards(one: Exciter, section: ExciterSection, rig: Rig) -> Iterator[str]:
    """What may harm an exciter, and what the model then misses, by key."""
    volts = rig.limits.level * one.largest_gain * one.voltage
    heat, rated = one.heat_by(volts), rated_power(section)
    if heat > _NEARLY * rated:
        yield (
            f"gains: of up to {one.largest_gain:.3g} put {heat:.3g} W into the coil at full level, "
            f"which bears {rated:.3g} W; lower power, or limits.level"
        )
    if section.clip is not None and volts > _NEARLY * section.clip:
        yield (
            f"gains: of up to {one.largest_gain:.3g} ask for {volts:.3g} V at full level, and the "
            f"amplifier clips at {section.clip:.3g} V; lower power, or limits.level"
        )
    if not math.isfinite(one.excursion):
        yield "excursion: missing, so that nothing limits how far its magnet moves; add it"
    sag = 0.0 if one.held else GRAVITY * one.magnet_mass / one.stiffness
    if math.isfinite(one.excursion) and sag > one.excursion:
        yield (
            f"resonance: of {one.magnet_frequency:.3g} Hz when glued, at which the magnet hangs "
            f"{1e3 * sag:.2g} mm from its middle by its weight, of an excursion of "
            f"{1e3 * one.excursion:.2g} mm; check resonance, resonance_is and weight, or hold it"
        )
    highest = rig.limits.frequency_max
    lag = (2 * math.pi * highest * one.inductance / one.loop_resistance) ** 2
    if lag > _LAG:
        yield (
            f"inductance: (omega L / R)² is {lag:.2g} at {highest:g} Hz, by which onsets, "
            "endings and courses are computed too strong or too weak; check it, or end "
            f"limits.frequency at {math.floor(highest * math.sqrt(_LAG / lag))} Hz"
        )

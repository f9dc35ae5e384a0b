"""What the exciters of a rig can follow: from which frequency on, and what its file may mean."""

import math
from collections.abc import Iterator
from dataclasses import dataclass
from pkgutil import resolve_name
from typing import Any

import numpy as np
from numpy.typing import NDArray

from model.arrays import FloatArray
from model.rig.exciter_section import ExciterSection
from model.rig.rig import Rig
from model.structure.exciter import Exciter
from model.structure.support import GRAVITY

_EXCURSIONS = "model.transients.excursions:excursions_of"
"""By name: it solves plates, which the packages above this one do."""

_NEARLY = 1.001
_LAG = 0.01  # (omega L / R)² from which time and frequency differ visibly
_ABOVE = 1.3  # times the resonance of a magnet, where little depends on it
_LIGHT, _HIGH = 0.3, 100.0  # share of the coil in the magnet's mass; Hz


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


def sections_of(rig: Rig) -> dict[str, ExciterSection]:
    """Keys of its exciters by name, none of a rig without keys."""
    keys: Any = rig.document.data["eras"] if rig.document else {}
    names = [one.name for one in exciters_of(rig) if one.name in keys]
    return {name: ExciterSection.model_validate(keys[name]) for name in names}


def excursion_notes(rig: Rig) -> Iterator[str]:
    """Yield a warning where full level would move magnets beyond their excursion."""
    exciters, limits = exciters_of(rig), rig.limits
    found: Excursions | None = resolve_name(_EXCURSIONS)(rig) if exciters else None
    if found is None or not found.passed.any():
        return
    shares = found.largest / [one.excursion for one in exciters]
    worst = int(shares.argmax())
    names = [one.name for one, is_far in zip(exciters, found.passed, strict=True) if is_far]
    lowest = (
        f"within from {found.allowed:g} Hz on" if np.isfinite(found.allowed) else "nowhere within"
    )
    yield (
        f"limits.frequency: from {limits.frequency_min:g} Hz on limits.level {limits.level:g} can "
        f"move the magnets of {', '.join(names)} beyond their excursion, that of "
        f"{exciters[worst].name} by {1e3 * found.largest[worst]:.2g} mm of "
        f"{1e3 * exciters[worst].excursion:.2g} mm ({lowest}); answers play less there, tones by "
        "hand do not: a level of at most "
        f"{math.floor(1e3 * limits.level / shares[worst]) / 1e3:g} is safe"
    )


def exciter_notes(rig: Rig) -> Iterator[str]:
    """Yield warnings: resonances that may be misread, and magnets that move too far or resonate.

    Of a resonance that may be misread it is not said from where on to play.
    """
    low, high = rig.limits.frequency_min, rig.limits.frequency_max
    sections = sections_of(rig)
    misread: dict[str, list[str]] = {}
    for name, section in sections.items():
        if said := _misread_resonance(section):
            misread.setdefault(said, []).append(name)
    yield from (f"resonance_is of {', '.join(names)}: {said}" for said, names in misread.items())
    for one in exciters_of(rig):
        yield from (f"eras.{one.name}.{each}" for each in _hazards(one, sections[one.name], rig))
    yield from excursion_notes(rig)
    doubted = {name for names in misread.values() for name in names}
    free = [one for one in exciters_of(rig) if not one.held and one.name not in doubted]
    near = {one.name: f for one in free if low < _ABOVE * (f := one.magnet_frequency)}
    if near:
        highest = max(near.values())
        start = math.ceil(_ABOVE * highest)
        advice = f"start at {start} Hz, or identify the rig" if start < high else "identify the rig"
        yield (
            f"limits.frequency: starts at {low:g} Hz, below {_ABOVE:g} times the resonance of the "
            f"magnets of {', '.join(near)} at up to {highest:.1f} Hz, where "
            f"the field depends on suspension and weight as much as on the plate; {advice}"
        )


def _misread_resonance(section: ExciterSection) -> str | None:
    """A warning for a resonance that is said to be the mounted one, and hardly can be."""
    values = section.values
    f, coil, weight = values["resonance"], values["coil_mass"], values["weight"]
    if section.stiffness or values["resonance_is"] != "mounted":
        return None
    if f <= _HIGH or coil >= _LIGHT * weight:
        return None
    return (
        f"{f:g} Hz is high for a magnet of {1e3 * weight:.3g} g, and probably that of the coil of "
        f"{1e3 * coil:.3g} g on a data sheet; with resonance_is: free the glued magnet resonates "
        f"at {f * math.sqrt(coil / weight):.0f} Hz"
    )


def _hazards(one: Exciter, section: ExciterSection, rig: Rig) -> Iterator[str]:
    """Yield what may harm an exciter, and what the model then misses, by key."""
    volts, limits = rig.limits.level * one.largest_gain * one.voltage, rig.limits
    heat = (volts / one.loop_resistance) ** 2 * one.resistance / 2
    by_gains = f"gains: of up to {one.largest_gain:.3g}"
    rated = section.of_type.get("power", section.values["power"])
    if heat > _NEARLY * rated:
        yield (
            f"{by_gains} put {heat:.3g} W into the coil at full level, which bears {rated:.3g} W; "
            "lower power, or limits.level"
        )
    if section.clip is not None and volts > _NEARLY * section.clip:
        yield (
            f"{by_gains} ask for {volts:.3g} V at full level, and the amplifier clips at "
            f"{section.clip:.3g} V; lower power, or limits.level"
        )
    if not math.isfinite(one.excursion):
        yield "excursion: missing, so that nothing limits how far its magnet moves; add it"
    sag = 0.0 if one.held else GRAVITY * one.magnet_mass / one.stiffness
    if sag > one.excursion:
        yield (
            f"resonance: of {one.magnet_frequency:.3g} Hz when glued, at which the magnet hangs "
            f"{1e3 * sag:.2g} mm from its middle by its weight, of an excursion of "
            f"{1e3 * one.excursion:.2g} mm; check resonance, resonance_is and weight, or hold it"
        )
    highest = limits.frequency_max
    lag = (2 * math.pi * highest * one.inductance / one.loop_resistance) ** 2
    if lag > _LAG:
        yield (
            f"inductance: (omega L / R)² is {lag:.2g} at {highest:g} Hz, by which onsets, "
            "endings and courses are computed too strong or too weak; check it, or end "
            f"limits.frequency at {math.floor(highest * math.sqrt(_LAG / lag))} Hz"
        )

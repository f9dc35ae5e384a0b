"""Warnings about the values of a rig file: hazards, wrong units, and effects that are neglected.

Warnings that need solved plates or wires are in `controller.rig_file_check`.
"""

import cmath
import math
from collections.abc import Iterator
from itertools import pairwise

from model.rig.actuator_keys import STIFF_MOUNT, ExciterSection
from model.rig.rig import Rig
from model.rig.rig_summary import attachment_keys, exciters_of, sections_of
from model.spectral.plate_mesh import KnownModes
from model.structure.attachments import DEFAULT_POINTS, least_points
from model.structure.exciter import Exciter
from model.structure.laminate_bending import slide_frequency
from model.structure.sources import Era, Gain, Source
from model.structure.statics import GRAVITY
from model.structure.surface import WELL_KNOWN
from registry.limits import GuardLimits

_TOLERANCE = 1.001  # factor on rated values, for rounding

_MAX_LAG = 0.01  # (omega L / R)² above which results in time and frequency domain differ visibly

_ABOVE_RESONANCE = 1.3  # times a magnet's resonance; above it, the resonance matters little

_LIGHT_COIL = 0.3  # mass of a coil relative to the magnet's, for a misread resonance

_HIGH_RESONANCE = 100.0  # Hz, for a misread resonance of a mounted magnet

_THICK = 0.02  # m, for a single material

_KNOWN_SHARE = 0.9
"""Fraction of the frequency up to which modes are needed; the highest mode can be this far below
it."""

_BELOW_SLIDING = 2.0
"""Modes are within 3 % of the direct solution up to half the frequency at which layers slide on
their own, and off by a similar factor near it (0.5 mm aluminum faces on 50 mm of E 0.1 to 10
MPa)."""

_MAX_ANGLE = math.radians(20.5)  # between two rows of gains


def exciter_notes(rig: Rig) -> Iterator[str]:
    """Yield warnings of resonances that can be misread, and of hazards to exciters."""
    sections = sections_of(rig)
    names_by_warning: dict[str, list[str]] = {}
    for name, section in sections.items():
        warning = _misread_resonance(section)
        if warning is not None:
            names_by_warning.setdefault(warning, []).append(name)
    for warning, names in names_by_warning.items():
        yield f"resonance_is of {', '.join(names)}: {warning}"
    for exciter in exciters_of(rig):
        for hazard in _hazards(exciter, sections[exciter.name], rig.limits):
            yield f"eras.{exciter.name}.{hazard}"


def resonance_notes(rig: Rig) -> Iterator[str]:
    """Yield a warning if a rig plays near the resonance of its magnets.

    Resonances with a suspicious value are skipped.
    """
    low, high = rig.limits.frequency_min, rig.limits.frequency_max
    misread = {name for name, section in sections_of(rig).items() if _misread_resonance(section)}
    resonances = {}
    for exciter in exciters_of(rig):
        if exciter.held or exciter.name in misread:
            continue
        if low < _ABOVE_RESONANCE * exciter.magnet_frequency:
            resonances[exciter.name] = exciter.magnet_frequency
    if not resonances:
        return
    highest = max(resonances.values())
    start = math.ceil(_ABOVE_RESONANCE * highest)
    advice = f"start at {start} Hz, or identify the rig" if start < high else "identify the rig"
    yield (
        f"limits.frequency: starts at {low:g} Hz, below {_ABOVE_RESONANCE:g} times the resonance "
        f"of the magnets of {', '.join(resonances)} at up to {highest:.1f} Hz, where the field "
        f"depends on the suspension, the weight and the plate alike; {advice}"
    )


def _misread_resonance(section: ExciterSection) -> str | None:
    """Return a warning for a `mounted` resonance that is too high to be one."""
    values = section.values
    resonance, coil, weight = values["resonance"], values["coil_mass"], values["weight"]
    if section.stiffness or values["resonance_is"] != "mounted":
        return None
    if resonance <= _HIGH_RESONANCE or coil >= _LIGHT_COIL * weight:
        return None
    mounted = resonance * math.sqrt(coil / weight)
    return (
        f"{resonance:g} Hz is high for a magnet of {1e3 * weight:.3g} g, and probably refers to "
        f"the coil of {1e3 * coil:.3g} g, like most data sheets; with resonance_is: free the "
        f"glued magnet resonates at {mounted:.0f} Hz"
    )


def _hazards(exciter: Exciter, section: ExciterSection, limits: GuardLimits) -> Iterator[str]:
    """Yield hazards to an exciter, and effects that the model then misses, by key."""
    yield from _voltage_hazards(exciter, section, limits.level)
    if not math.isfinite(exciter.excursion):
        yield "excursion: missing, so the motion of its magnet is unlimited; add it"
    sag = 0.0 if exciter.held else GRAVITY * exciter.magnet_mass / exciter.stiffness
    if sag > exciter.excursion:
        yield (
            f"resonance: of {exciter.magnet_frequency:.3g} Hz when glued, at which the magnet sags "
            f"{1e3 * sag:.2g} mm from its center under its weight, with an excursion of "
            f"{1e3 * exciter.excursion:.2g} mm; check resonance, resonance_is and weight, or hold "
            "it"
        )
    highest = limits.frequency_max
    lag = (2 * math.pi * highest * exciter.inductance / exciter.loop_resistance) ** 2
    if lag > _MAX_LAG:
        yield (
            f"inductance: (omega L / R)² is {lag:.2g} at {highest:g} Hz, so onsets, "
            "endings and envelopes are computed too strong or too weak; check it, or end "
            f"limits.frequency at {math.floor(highest * math.sqrt(_MAX_LAG / lag))} Hz"
        )


def _voltage_hazards(exciter: Exciter, section: ExciterSection, level: float) -> Iterator[str]:
    """Yield hazards of gains whose voltage heats the coil too much, or makes the amplifier clip."""
    volts = level * exciter.largest_gain * exciter.voltage
    heat = (volts / exciter.loop_resistance) ** 2 * exciter.resistance / 2
    rated = section.of_type.get("power", section.values["power"])
    gains = f"gains: of up to {exciter.largest_gain:.3g}"
    if heat > _TOLERANCE * rated:
        yield (
            f"{gains} put {heat:.3g} W into the coil at full level, which is rated for "
            f"{rated:.3g} W; lower power, or limits.level"
        )
    if section.clip is not None and volts > _TOLERANCE * section.clip:
        yield (
            f"{gains} ask for {volts:.3g} V at full level, and the amplifier clips at "
            f"{section.clip:.3g} V; lower power, or limits.level"
        )


def plate_notes(rig: Rig) -> Iterator[str]:
    """Yield warnings of a plate in the wrong unit, and of neglected effects of air and soft
    layers."""
    plate, low, high = rig.plate, rig.limits.frequency_min, rig.limits.frequency_max
    yield from rig.surface_notes
    needed = WELL_KNOWN * high
    if isinstance(rig.mesh, KnownModes) and rig.mesh.frequency < _KNOWN_SHARE * needed:
        yield (
            f"surface: {rig.mesh} leave fields uncertain at {high:g} Hz (limits.frequency); export "
            f"modes up to {needed:g} Hz, {WELL_KNOWN:g} times as high"
        )
    if rig.laminate is None and plate.thickness > _THICK:
        yield (
            f"plate.thickness: {1e3 * plate.thickness:g} mm is too thick to be felt; "
            "check its unit, mm or cm"
        )
    error = 0.0 if plate.air_gap is None else plate.air_gap.coupling_error(low)
    if plate.air_gap is not None and error:
        off = "50 % or more: do not use the result" if error > 0.1 else f"{100 * error:g} %"
        yield (
            f"plate.air_gap: air friction in {1e3 * plate.air_gap.depth:g} mm couples the "
            f"modes at {low:g} Hz, which is neglected: the response can be off by {off}"
        )
    slide = math.inf if plate.laminate is None else slide_frequency(plate.laminate, high)
    highest = slide / _BELOW_SLIDING
    if high >= highest:
        yield (
            f"plate.layers: at {slide:.3g} Hz they slide back and forth on their own, and change "
            "their thickness little above, which is neglected: do not use results above "
            f"{highest:.3g} Hz"
        )


def mount_notes(rig: Rig) -> Iterator[str]:
    """Yield warnings of stiff mounts that are points, and edges with too few points for many
    waves."""
    compliance_a_decade = math.log(10) / (2 * math.pi * rig.plate.shear_rigidity)
    mounts = {era.name: era.support for era in rig.eras}
    passive_mounts = rig.masses[len(rig.masses) - len(rig.supports) :]
    mounts |= zip(rig.supports, passive_mounts, strict=True)
    for name, mount in mounts.items():
        if mount.stiffness >= STIFF_MOUNT and not mount.foot:
            percent = 100 * compliance_a_decade * mount.stiffness
            yield (
                f"eras.{name}.foot: the dent under a point of {mount.stiffness:g} N/m has no "
                f"limit, a tenfold smaller one adds at least {percent:.1f} % of the mount's own "
                "compliance; give its radius, and see `era plate convergence`"
            )
    high = rig.limits.frequency_max
    needed = least_points(rig.plate, high)
    for kind in ("masses", "supports"):
        for name, keys in attachment_keys(rig, kind).items():
            count = keys.get("points", DEFAULT_POINTS)
            if "along" in keys and count < needed:
                yield (
                    f"{kind}.{name}.points: {count} on each edge are few at {high:g} Hz; give "
                    f"{needed}"
                )


def gain_notes(rig: Rig) -> list[str]:
    """Return warnings of missing gains behind an output, and of gains with rows too far apart.

    Other actuators than ERAs need no gains behind an output.
    """
    at_outputs = [era for era in rig.eras if rig.wiring[era.name].amplifier in rig.outputs]
    names = [era.name for era in at_outputs if isinstance(era, Era) and not era.gains]
    warnings = []
    if names:
        warnings.append(
            f"gains of {', '.join(names)}: missing behind an output, so their motion is "
            "assumed to be the stroke at full level at every frequency; measure the plate and "
            "calibrate the rig"
        )
    for era in at_outputs:
        warnings += _phase_warnings(era, rig.limits)
    return warnings


def _phase_warnings(era: Source, limits: GuardLimits) -> Iterator[str]:
    """Yield a warning of the largest phase difference between two rows of gains, if too large."""
    largest = 0.0
    frequencies = (0.0, 0.0)
    for row, next_row in pairwise(era.gains):
        if row[0] < limits.frequency_max and next_row[0] > limits.frequency_min:
            angle = _angle_between(row, next_row)
            if angle >= largest:
                largest = angle
                frequencies = (row[0], next_row[0])
    if largest > _MAX_ANGLE:
        first, last = frequencies
        yield (
            f"eras.{era.name}.gains: phases differ by {math.degrees(largest):.0f} degrees between "
            f"{first:g} and {last:g} Hz, at most 20 are interpolated well; measure between them"
        )


def _angle_between(row: Gain, next_row: Gain) -> float:
    """Return the angle [rad] between the phases of two gains, at most pi."""
    return abs(cmath.phase(cmath.rect(1, next_row[2] - row[2])))

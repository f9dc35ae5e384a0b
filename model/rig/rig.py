"""Rig: a plate, its ERAs, their amplifier channels, and the uncertainty of its parameters.

`physics_of` returns the properties of a rig that must match a table.
"""

import hashlib
import json
import math
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field, fields
from functools import cached_property
from numbers import Real
from typing import Any

from model.config.document import Document
from model.errors import InputError, expect_between
from model.finger import DEFAULT_THRESHOLD, FINGERTIP_RADIUS, PUBLISHED_THRESHOLDS
from model.spectral.plate_mesh import PlateMesh
from model.structure.attachments import FEET_DEVIATE, PointLoad, feet_of
from model.structure.exciter import Actuator
from model.structure.fingertips import Fingertip
from model.structure.plate import Laminate, Plate
from registry.limits import GuardLimits
from registry.plugins import did_you_mean

BOUNDS = {
    "gain": (0.0, 0.5),
    "phase_deg": (0.0, 60.0),
    "thickness": (0.0, 0.03),
    "stiffness": (0.0, 0.5),
    "damping": (1.0, 4.0),
    "fingertip": (0.0, 1.0),
    "common_gain": (0.0, 0.5),
    "level": (0.0, 0.3),
    "field": (0.0, 0.5),
    "modulus": (0.0, 0.1),
    "place": (0.0, 0.01),
    "touch_position": (0.0, 0.01),
    "harmonic": (0.0, 0.2),
    "supports": (0.0, 0.5),
    "weather": (0.0, 0.5),
    "foreign_mass": (0.0, 2.0),
    "mode_frequency": (0.0, 0.1),
    "mode_amplitude": (0.0, 0.3),
}
"""Allowed values of each parameter: the value for exactly known, and the maximum."""

_RELATIVE = (
    "gain",
    "thickness",
    "modulus",
    "weather",
    "stiffness",
    "supports",
    "common_gain",
    "level",
    "field",
    "harmonic",
    "mode_frequency",
    "mode_amplitude",
)

LEVEL_PHASE = 0.5
"""Change of the phase [rad] relative to that of the gain; 4 / (3 pi) by Rayleigh's law of
hysteresis."""

_LEVEL_STD = 0.125
"""Standard deviation of the levels of the ERAs in a tone, in factors of ten, for a single ERA.

All gains change by the same law, so that errors of n ERAs add as amplitudes, not as powers. Fitted:
86 to 94 % of promises are kept with 4 and with 12 ERAs (`python -m benchmarks.promise levels`).
"""

MAX_UNCERTAINTY = 1000.0
"""Largest value of any uncertainty, also in studies of plates beyond BOUNDS."""


def _level_std(era_count: int) -> float:
    return _LEVEL_STD * math.sqrt(era_count)


@dataclass(frozen=True)
class Uncertainty:
    """One standard deviation per parameter; parameters are independent.

    The defaults are for a plate built from its drawing and not measured.
    """

    gain: float = 0.05
    """Gain of each channel, relative."""
    phase_deg: float = 5.0
    """Phase of each channel [degrees]."""
    thickness: float = 0.02
    """Thickness of the plate, relative."""
    stiffness: float = 0.1
    """Stiffness of each ERA, relative."""
    damping: float = 1.5
    """Factor on the ERAs' damping and on the plate's loss factor; 1 for no uncertainty."""
    fingertip: float = 0.5
    """Logarithm of each finger's load."""
    common_gain: float = 0.0
    """Common gain of all channels, relative."""
    level: float = 0.0
    """Change of each channel's gain from full level to a tenth of it, relative; its phase changes
    by half as much in radians."""
    field: float = 0.0
    """Motion caused by one ERA at a finger, relative to its RMS over the plate, in addition to all
    other uncertainties."""
    modulus: float = 0.02
    """Modulus of elasticity of the plate, relative; it counts as 0 if `thickness` is 0."""
    place: float = 0.001
    """Position of each ERA, along x and along y [m]."""
    harmonic: float = 0.01
    """Second harmonic of each ERA's motion, RMS relative to the ERA's own amplitude, at any
    phase."""
    supports: float = 0.0
    """Logarithm of the stiffness of each foot; a rig file with feet has a default of 0.3."""
    weather: float = 0.0
    """Modulus of the plate due to temperature and moisture, relative, even if the thickness is
    known.

    The default in a rig file is derived from `plate.temperature` and `plate.humidity`.
    """
    foreign_mass: float = 0.0
    """Mass [kg] of an object anywhere on the plate, 0 if none is expected."""
    mode_frequency: float = 0.0
    """Natural frequency of each mode individually, relative, in addition to shifts common to all
    modes."""
    mode_amplitude: float = 0.0
    """Amplitude of each elastic mode shape individually, relative."""
    touch_position: float = 0.002
    """Distance of each finger from the position that the touch source reports, RMS [m]."""

    def __post_init__(self) -> None:
        """Reject values that are not finite, negative values, and a factor below 1."""
        for key, (exact, _) in BOUNDS.items():
            expect_between(getattr(self, key), exact, MAX_UNCERTAINTY, what=f"uncertainty: {key}")

    @classmethod
    def none(cls) -> "Uncertainty":
        """Return the uncertainty of an exactly known rig."""
        return cls(**{key: exact for key, (exact, _) in BOUNDS.items()})

    @classmethod
    def clipped(cls, **estimates: float) -> "Uncertainty":
        """Return an uncertainty from estimates, each clipped to BOUNDS."""
        clipped = {}
        for key, value in estimates.items():
            low, high = BOUNDS[key]
            clipped[key] = min(max(value, low), high)
        return cls(**clipped)

    def __str__(self) -> str:
        """Format the terms that are uncertain, as 'gain 5 %, phase 5°, damping x 1.5'."""
        terms = []
        for key in _RELATIVE:
            share = getattr(self, key)
            if share:
                terms.append(f"{key.replace('_', ' ')} {100 * share:.3g} %")
        if self.phase_deg:
            terms.append(f"phase {self.phase_deg:.3g}°")
        if self.damping > 1:
            terms.append(f"damping x {self.damping:.4g}")
        if self.fingertip:
            terms.append(f"fingertip x {math.exp(self.fingertip):.2g}")
        if self.place:
            terms.append(f"place {1e3 * self.place:.3g} mm")
        if self.touch_position:
            terms.append(f"touch position {1e3 * self.touch_position:.3g} mm")
        if self.foreign_mass:
            terms.append(f"foreign mass {1e3 * self.foreign_mass:.3g} g")
        return ", ".join(terms) or "none"

    def played_gain(self, era_count: int) -> float:
        """Relative error of a channel's gain in a tone of several ERAs at different levels."""
        return math.hypot(self.gain, _level_std(era_count) * self.level)

    def played_phase(self, era_count: int) -> float:
        """Error of a channel's phase [rad] in a tone of several ERAs at different levels."""
        by_level = _level_std(era_count) * LEVEL_PHASE * self.level
        return math.hypot(math.radians(self.phase_deg), by_level)

    def gain_variance(self, era_count: int) -> float:
        """Mean square of a channel's relative error, phase included: (1 + g²) exp(p²) - 1.

        Relative to the mean over all channels, whose amplitude is smaller by exp(-p² / 2); p in
        radians.
        """
        phase = self.played_phase(era_count)
        return (1 + self.played_gain(era_count) ** 2) * math.exp(phase**2) - 1

    @property
    def elasticity(self) -> float:
        """Relative standard deviation of the modulus; only due to weather for an exactly known
        thickness."""
        return math.hypot(self.modulus if self.thickness > 0 else 0.0, self.weather)

    @property
    def frequency(self) -> float:
        """Relative standard deviation of natural frequencies, due to thickness and modulus."""
        return math.hypot(self.thickness, self.elasticity / 2)

    @property
    def touch_offset(self) -> float:
        """Standard deviation of a touch's position along x and along y [m]."""
        return self.touch_position / math.sqrt(2)

    @property
    def changes_modes(self) -> bool:
        """Whether modes are uncertain, jointly or individually."""
        return max(self.frequency, self.mode_frequency, self.mode_amplitude) > 0

    @staticmethod
    def of_frequency(std: float) -> dict[str, float]:
        """Return equal uncertainties of thickness and modulus that give a relative standard
        deviation of natural frequencies."""
        share = std / math.hypot(1.0, 0.5)
        return {"thickness": share, "modulus": share}


SAME_POINT = 1e-6  # m; two bolts cannot be closer


@dataclass(frozen=True)
class Channel:
    """Wiring of an ERA: name of an amplifier in the rig, and channel number."""

    amplifier: str
    number: int


@dataclass(frozen=True)
class Rig:
    """Plate on its ERAs, with wiring and limits."""

    plate: Plate
    mesh: PlateMesh
    eras: tuple[Actuator, ...]
    """Driven actuators."""
    wiring: Mapping[str, Channel]
    """Channel by ERA name."""
    amplifiers: Mapping[str, str]
    """URL by name."""
    limits: GuardLimits
    masses: tuple[PointLoad, ...] = ()
    """Masses on the plate and passive supports; ERAs without an amplifier come last."""
    laminate: Laminate | None = None
    """Layers of the plate, even if it is solved as a homogeneous plate; None for a single layer."""
    uncertainty: Uncertainty = field(default_factory=Uncertainty)
    """Uncertainty of the rig's parameters."""
    fingertip: Fingertip | None = field(default_factory=Fingertip)
    """Load of each finger on the plate; None for massless fingers."""
    threshold: str = DEFAULT_THRESHOLD
    """Name of the threshold set to which levels are relative (`model.finger`)."""
    promised_thresholds: tuple[str, ...] = PUBLISHED_THRESHOLDS
    """Threshold sets for which promises hold, in addition to `threshold`."""
    supports: tuple[str, ...] = ()
    """Names of the ERAs without an amplifier."""
    outputs: frozenset[str] = frozenset()
    """Amplifiers whose level is an electrical output; gains relate this output to the bases'
    motion."""
    clock_errors: Mapping[str, float] = field(default_factory=dict)
    """Assumed clock error of each amplifier [s]; infinite if its clock cannot be steered."""
    document: Document | None = field(default=None, compare=False, repr=False)
    """Keys of the rig file, if the rig was read from one."""

    def __post_init__(self) -> None:
        """Check that ERAs and masses are on the plate, with unique positions and names of ERAs."""
        for era in self.eras:
            self._check_on_plate(f"ERA {era.name}", era.x, era.y)
        for mass in self.masses:
            self._check_on_plate("point mass", mass.x, mass.y)
        for number, era in enumerate(self.eras):
            for earlier in self.eras[:number]:
                _check_distinct(earlier, era)

    def _check_on_plate(self, what: str, x: float, y: float) -> None:
        plate = self.plate
        if not plate.contains(x, y):
            raise InputError(
                f"{what} must be on the plate, from (0, 0) to ({plate.length:g}, "
                f"{plate.width:g}) m, got ({x:g}, {y:g}) m"
            )

    def era(self, name: str) -> Actuator:
        """Return an ERA by name; raises InputError for an unknown name."""
        eras = {era.name: era for era in self.eras}
        if name not in eras:
            raise InputError(
                f"unknown ERA {name!r}; {did_you_mean(str(name), eras)}"
                f"choose from {', '.join(eras)}"
            )
        return eras[name]

    @property
    def grain(self) -> str:
        """Side along which the grain of a board runs according to its keys."""
        keys: Mapping[str, Any] = self.document.data if self.document else {}
        return str(keys.get("plate", {}).get("grain", "length"))

    @cached_property
    def full_levels(self) -> dict[str, float]:
        """Full level of each ERA by name: its stroke [m], or volts for an exciter."""
        return {era.name: era.full_level for era in self.eras}

    @property
    def exactly_known(self) -> tuple[str, ...]:
        """Keys of the uncertainty that are zero although every real plate has some."""
        built = Uncertainty(supports=FEET_DEVIATE if self.feet else 0.0)
        return tuple(
            key
            for key, (exact, _) in BOUNDS.items()
            if getattr(self.uncertainty, key) == exact != getattr(built, key)
        )

    @property
    def uncertainty_note(self) -> str | None:
        """A line about uncertainties that are assumed to be zero; None if there are none."""
        if not self.exactly_known:
            return None
        return (
            f"uncertainty taken as zero: {', '.join(self.exactly_known)}; promises assume that "
            f"these are exactly known, the rest: {self.uncertainty}"
        )

    @property
    def surface_notes(self) -> tuple[str, ...]:
        """Warnings about modes of its surface, one line each; empty for a plate."""
        return () if self.plate.surface is None else self.plate.surface.notes

    @cached_property
    def feet(self) -> tuple[int, ...]:
        """Indices of the masses that are feet, in file order."""
        return feet_of(self.masses)

    @property
    def foot_names(self) -> tuple[str, ...]:
        """Names of the feet in its file; a foot without a name has its number from 1."""
        supports: Any = self.document.data.get("supports", {}) if self.document else {}
        names = [name for name, keys in supports.items() if "at" in keys]
        return tuple(names or map(str, range(1, 1 + len(self.feet))))

    @property
    def largest_stiffness(self) -> float:
        """Stiffness of the stiffest actuator spring [N/m], for the accuracy of a mesh."""
        return max(era.in_time.stiffness for era in self.eras)

    @property
    def channel_counts(self) -> Counter[str]:
        """Number of wired channels by amplifier name."""
        return Counter(channel.amplifier for channel in self.wiring.values())

    @property
    def fingerprint(self) -> str:
        """Fingerprint of all properties that affect the sensation; see `fingerprint_of`."""
        return fingerprint_of(self)


def _check_distinct(first: Actuator, second: Actuator) -> None:
    """Raise InputError if two ERAs have the same name or position."""
    if first.name == second.name:
        raise InputError(f"names of ERAs must be unique, got {first.name} twice; rename one")
    if math.dist((first.x, first.y), (second.x, second.y)) < SAME_POINT:
        raise InputError(
            f"ERAs must be at different positions, got {first.name} and {second.name} at "
            f"({second.x:g}, {second.y:g}) m; move one ERA"
        )


MAY_DIFFER = {
    "Rig.mesh": "the discretization error of its own mesh is part of a table",
    "Rig.wiring": "affects where levels go, not their effect",
    "Rig.amplifiers": "affects where levels go, not their effect",
    "Rig.limits": "checked against the rig in service whenever a pattern is played",
    "Rig.outputs": "an amplifier with another value is rejected when it is opened",
    "Rig.clock_errors": "each amplifier states its own when it is opened",
    "Rig.supports": "affects the names of masses, not their weights",
    "Rig.document": "repeats other fields",
    "Rig.laminate": "the solved values are in the plate",
    "Material.name": "displayed only",
    "Surface.file": "the digest identifies its content",
    "Surface.notes": "they follow from its modes",
}
"""Properties in which a table's rig can differ, by class and field, each with the reason.

All other fields, including every new field, must match.
"""

PHYSICS = tuple(field.name for field in fields(Rig) if f"Rig.{field.name}" not in MAY_DIFFER)
"""Fields of a rig that are also stored in a table."""


def physics_of(source: object) -> dict[str, Any]:
    """Return the properties of a rig or a table that must match for equal answers, as plain data.

    source: a rig, or an object with the fields in PHYSICS. Empty defaults are left out, so that
    older tables stay valid when a field is added.
    """
    physics = {name: _plain(getattr(source, name)) for name in PHYSICS}
    # A laminate keeps its layers; its equivalent plate depends on the frequency.
    if "laminate" in physics["plate"]:
        del physics["plate"]["material"], physics["plate"]["thickness"]
    physics["masses"].sort(key=canonical_json)
    physics["names of eras"] = [era["name"] for era in physics["eras"]]
    physics["eras"] = {era["name"]: era for era in physics["eras"]}
    return physics | {"fingertip_radius": FINGERTIP_RADIUS}


def fingerprint_of(source: object) -> str:
    """Return the SHA-256 of `physics_of` a rig or a table: all properties that affect the
    sensation."""
    return hashlib.sha256(canonical_json(physics_of(source)).encode()).hexdigest()


def differences(table: object, rig: Rig) -> list[str]:
    """Describe the keys in which a table's values must match a rig's but differ by more than
    rounding."""
    return [*_differences("", physics_of(table), physics_of(rig))]


def _plain(value: Any) -> Any:
    """Convert a value to mappings, lists, floats and text, without MAY_DIFFER and empty
    defaults."""
    match value:
        case bool() | str() | None:
            return value
        case Real():
            return float(value) + 0.0
        case Mapping():
            return {key: _plain(entry) for key, entry in value.items()}
        case Iterable():
            return [_plain(entry) for entry in value]
    properties = {}
    for attribute in fields(value):
        content = getattr(value, attribute.name)
        is_empty_default = not content and content == attribute.default
        if f"{type(value).__name__}.{attribute.name}" not in MAY_DIFFER and not is_empty_default:
            properties[attribute.name] = _plain(content)
    return properties


def _differences(key: str, actual: Any, expected: Any) -> Iterator[str]:
    """Yield differences of plain data below a key; a list of another length differs as a whole."""
    if isinstance(actual, dict) and isinstance(expected, dict):
        for name in expected | actual:
            path = f"{key}.{name}".lstrip(".")
            yield from _differences(path, actual.get(name), expected.get(name))
    elif isinstance(actual, list) and isinstance(expected, list) and len(actual) == len(expected):
        for number, (entry, expected_entry) in enumerate(zip(actual, expected, strict=True)):
            yield from _differences(f"{key}[{number}]", entry, expected_entry)
    elif actual != expected and not _are_close(actual, expected):
        yield f"{key} must be {_in_digits(expected):.60}, got {_in_digits(actual):.60}"


def _are_close(value: Any, expected: Any) -> bool:
    """Return whether two values are numbers that differ by no more than rounding."""
    return type(value) is type(expected) is float and math.isclose(value, expected)


def _in_digits(value: Any) -> str:
    return f"{value:.9g}" if type(value) is float else str(value)


def canonical_json(value: object) -> str:
    """Return JSON with sorted keys, the same for 1 and 1.0, and for -0.0 and 0.0."""
    return json.dumps(_plain(value), sort_keys=True, separators=(",", ":"))

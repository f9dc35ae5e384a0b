"""A rig: a plate, its ERAs, their amplifier channels, and how well all of them are known.

Also here: which parts of a rig must be the same for a table to hold (`physics_of`), and named
layouts of ERAs. The drawings of the paper's layouts (its Figures 8 and 9) are not available, so
these are our own; their places are fractions of the plate's sides, so that a layout fits every
plate.
"""

import hashlib
import json
import math
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field, fields, replace
from functools import cached_property
from numbers import Real
from typing import Any

import numpy as np

from model.arrays import FloatArray
from model.config.document import Document
from model.errors import InputError, expect_between
from model.finger import DEFAULT_THRESHOLD, FINGERTIP_RADIUS, THRESHOLDS
from model.spectral.modes import PlateMesh
from model.structure.attachments import FEET_DEVIATE, Fingertip, PointLoad, feet_of
from model.structure.exciter import Actuator, OneKind
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
    "field": (0.0, 0.5),
    "modulus": (0.0, 0.1),
    "place": (0.0, 0.01),
    "harmonic": (0.0, 0.2),
    "supports": (0.0, 0.5),
    "weather": (0.0, 0.5),
    "foreign_mass": (0.0, 2.0),
    "mode_frequency": (0.0, 0.1),
    "mode_amplitude": (0.0, 0.3),
}
"""What a rig may state of each parameter: exactly known, and the most."""

_RELATIVE = (
    "gain",
    "thickness",
    "modulus",
    "weather",
    "stiffness",
    "supports",
    "common_gain",
    "field",
    "harmonic",
    "mode_frequency",
    "mode_amplitude",
)

MAX_UNCERTAINTY = 1000.0
"""Largest value of any uncertainty, also in a study of plates beyond BOUNDS."""


@dataclass(frozen=True)
class Uncertainty:
    """One standard deviation of each parameter; independent of each other.

    The defaults are those of a plate as built from its drawing and not measured.
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
    """A factor, of the ERAs' damping and of the plate's loss factor; 1 for none."""
    fingertip: float = 0.5
    """Logarithm of each finger's load."""
    common_gain: float = 0.0
    """Gain of all channels together, relative."""
    field: float = 0.0
    """Motion that one ERA causes at a finger, relative to its root mean square over the
    plate, beside all other uncertainties."""
    modulus: float = 0.02
    """Modulus of elasticity of the plate, relative; it counts as 0 if `thickness` is 0."""
    place: float = 0.001
    """Place of each ERA, along x and along y [m]."""
    harmonic: float = 0.01
    """Second harmonic of each ERA's motion, root mean square as a share of its own amplitude, of
    any phase."""
    supports: float = 0.0
    """Logarithm of the stiffness of each foot; 0.3 of a rig file with feet by default."""
    weather: float = 0.0
    """Modulus of the plate by temperature and moisture, relative, even if the thickness is known.

    A rig file derives its default from `plate.temperature` and `plate.humidity`.
    """
    foreign_mass: float = 0.0
    """Mass [kg] of an object that may lie anywhere on the plate, 0 where none is expected."""
    mode_frequency: float = 0.0
    """Natural frequency of each mode by itself, relative, beside what moves all together."""
    mode_amplitude: float = 0.0
    """Size of the shape of each elastic mode by itself, relative."""

    def __post_init__(self) -> None:
        """Refuse values that are not finite, negative ones, and a factor below 1."""
        for key, (exact, _) in BOUNDS.items():
            expect_between(getattr(self, key), exact, MAX_UNCERTAINTY, what=f"uncertainty: {key}")

    @classmethod
    def none(cls) -> "Uncertainty":
        """A rig whose every parameter is known exactly."""
        return cls(**{key: exact for key, (exact, _) in BOUNDS.items()})

    @classmethod
    def clipped(cls, **estimates: float) -> "Uncertainty":
        """An uncertainty by estimates, each brought within BOUNDS."""
        return cls(
            **{
                key: min(max(value, BOUNDS[key][0]), BOUNDS[key][1])
                for key, value in estimates.items()
            }
        )

    def __str__(self) -> str:
        """Its terms that are not none, as 'gain 5 %, phase 5°, damping x 1.5'."""
        percents = [
            f"{key.replace('_', ' ')} {100 * getattr(self, key):.3g} %"
            for key in _RELATIVE
            if getattr(self, key)
        ]
        others = [
            f"phase {self.phase_deg:.3g}°" if self.phase_deg else "",
            f"damping x {self.damping:.4g}" if self.damping > 1 else "",
            f"fingertip x {math.exp(self.fingertip):.2g}" if self.fingertip else "",
            f"place {1e3 * self.place:.3g} mm" if self.place else "",
            f"foreign mass {1e3 * self.foreign_mass:.3g} g" if self.foreign_mass else "",
        ]
        return ", ".join([*percents, *filter(None, others)]) or "none"

    @property
    def gain_variance(self) -> float:
        """Mean square of a channel's relative error, phase included: (1 + g²) exp(p²) - 1.

        Relative to the mean of all, whose amplitude is smaller by exp(-p² / 2); p in radians.
        """
        return (1 + self.gain**2) * math.exp(math.radians(self.phase_deg) ** 2) - 1

    @property
    def elasticity(self) -> float:
        """Relative standard deviation of the modulus; only by weather if the thickness is known."""
        return math.hypot(self.modulus if self.thickness > 0 else 0.0, self.weather)

    @property
    def frequency(self) -> float:
        """Relative standard deviation of natural frequencies, by thickness and modulus."""
        return math.hypot(self.thickness, self.elasticity / 2)

    @property
    def changes_modes(self) -> bool:
        """Whether modes are uncertain, all together or each by itself."""
        return max(self.frequency, self.mode_frequency, self.mode_amplitude) > 0

    @staticmethod
    def of_frequency(std: float) -> dict[str, float]:
        """Thickness and modulus, as uncertain as each other, of that of natural frequencies."""
        each = std / math.hypot(1.0, 0.5)
        return {"thickness": each, "modulus": each}


# m; two bolts cannot be closer
SAME_POINT = 1e-6


@dataclass(frozen=True)
class Channel:
    """The wiring of an ERA: an amplifier by its name in the rig, and the number of its channel."""

    amplifier: str
    number: int


@dataclass(frozen=True)
class Rig:
    """A plate on its ERAs, with wiring and limits."""

    plate: Plate
    mesh: PlateMesh
    eras: tuple[Actuator, ...]
    """Those that are driven."""
    wiring: Mapping[str, Channel]
    """Channel by the name of the ERA."""
    amplifiers: Mapping[str, str]
    """URL by name."""
    limits: GuardLimits
    masses: tuple[PointLoad, ...] = ()
    """On the plate, and what supports it without being driven: last, ERAs without an amplifier."""
    laminate: Laminate | None = None
    """Layers of the plate, even if it is solved as a homogeneous one; None if it has one layer."""
    uncertainty: Uncertainty = field(default_factory=Uncertainty)
    """How well its parameters are known."""
    fingertip: Fingertip | None = field(default_factory=Fingertip)
    """Load of each finger on the plate; None for weightless ones."""
    threshold: str = DEFAULT_THRESHOLD
    """Name of the set of detection thresholds that levels are above (`model.finger`)."""
    promised_thresholds: tuple[str, ...] = THRESHOLDS
    """Names of the sets by which promises hold, beside that one."""
    supports: tuple[str, ...] = ()
    """Names of the ERAs without an amplifier."""
    outputs: frozenset[str] = frozenset()
    """The amplifiers whose full level is an output, to which bases move by their gains."""
    clock_errors: Mapping[str, float] = field(default_factory=dict)
    """What each amplifier is taken to state of its clock [s]; infinite if it cannot be steered."""
    document: Document | None = field(default=None, compare=False, repr=False)
    """Its keys."""

    def __post_init__(self) -> None:
        """Check that ERAs and masses are on the plate, and places and names of ERAs unique."""
        for what, place in (
            *((f"ERA {era.name}", (era.x, era.y)) for era in self.eras),
            *(("point mass", (mass.x, mass.y)) for mass in self.masses),
        ):
            if not self.plate.contains(*place):
                raise InputError(
                    f"{what} must be on the plate, from (0, 0) to ({self.plate.length:g}, "
                    f"{self.plate.width:g}) m, got ({place[0]:g}, {place[1]:g}) m"
                )
        for number, era in enumerate(self.eras):
            for other in self.eras[:number]:
                if era.name == other.name:
                    raise InputError(
                        f"names of ERAs must be unique, got {era.name} twice; rename one"
                    )
                if math.dist((era.x, era.y), (other.x, other.y)) < SAME_POINT:
                    raise InputError(
                        f"ERAs must be at different places, got {other.name} and {era.name} at "
                        f"({era.x:g}, {era.y:g}) m; move one of them"
                    )

    def era(self, name: str) -> Actuator:
        """The ERA of a name; raises InputError for an unknown one."""
        eras = {era.name: era for era in self.eras}
        if name not in eras:
            raise InputError(
                f"unknown ERA {name!r}; {did_you_mean(str(name), eras)}"
                f"choose from {', '.join(eras)}"
            )
        return eras[name]

    @property
    def grain(self) -> str:
        """The side along which its keys say that the grain of a board runs."""
        keys: Mapping[str, Any] = self.document.data if self.document else {}
        return str(keys.get("plate", {}).get("grain", "length"))

    @cached_property
    def full_levels(self) -> dict[str, float]:
        """Full level of each ERA, by its name: its stroke [m], or volts of an exciter."""
        return {era.name: era.full_level for era in self.eras}

    @property
    def exactly_known(self) -> tuple[str, ...]:
        """Keys of its uncertainty that are taken as none, though a plate that is built has some."""
        built = Uncertainty(supports=FEET_DEVIATE if self.feet else 0.0)
        return tuple(
            key
            for key, (exact, _) in BOUNDS.items()
            if getattr(self.uncertainty, key) == exact != getattr(built, key)
        )

    @property
    def uncertainty_note(self) -> str | None:
        """One line on what is taken as none; None where every parameter is uncertain."""
        if not self.exactly_known:
            return None
        return (
            f"uncertainty taken as none: {', '.join(self.exactly_known)}; what is promised holds "
            f"for these known exactly, the rest: {self.uncertainty}"
        )

    @property
    def surface_notes(self) -> tuple[str, ...]:
        """Suspicious properties of its surface's modes, a line each; none of a plate."""
        return () if self.plate.surface is None else self.plate.surface.notes

    @cached_property
    def feet(self) -> tuple[int, ...]:
        """Numbers of the masses that are feet, in the order of their file."""
        return feet_of(self.masses)

    @property
    def foot_names(self) -> tuple[str, ...]:
        """Names of the feet in its file, without one their numbers from 1."""
        stated: Any = self.document.data.get("supports", {}) if self.document else {}
        named = [name for name, keys in stated.items() if "at" in keys]
        return tuple(named or [str(number) for number in range(1, 1 + len(self.feet))])

    @property
    def largest_stiffness(self) -> float:
        """That of the stiffest spring of an actuator [N/m], for the accuracy of a mesh."""
        return max(era.in_time.stiffness for era in self.eras)

    @property
    def channel_counts(self) -> Counter[str]:
        """Numbers of channels that are wired, by the amplifier's name."""
        return Counter(channel.amplifier for channel in self.wiring.values())

    @property
    def fingerprint(self) -> str:
        """Fingerprint of all that decides what is felt; see `fingerprint_of`."""
        return fingerprint_of(self)


MAY_DIFFER = {
    "Rig.mesh": "the discretisation error of its own mesh is part of a table",
    "Rig.wiring": "where levels go, not what they do",
    "Rig.amplifiers": "where levels go, not what they do",
    "Rig.limits": "patterns are held to those of the rig in service, whenever they are played",
    "Rig.outputs": "an amplifier that says otherwise is refused when it is opened",
    "Rig.clock_errors": "each amplifier states its own when it is opened",
    "Rig.supports": "which of the masses have a name, not what they weigh",
    "Rig.document": "all that it says is in the other fields",
    "Rig.laminate": "all that is solved of it is in the plate",
    "Material.name": "displayed only",
    "Surface.file": "its content is known by its digest",
    "Surface.notes": "they follow from its modes",
}
"""What a table's rig may have otherwise, by class and field, each with the reason.

Everything else, and so every new field, must be the same.
"""

PHYSICS = tuple(each.name for each in fields(Rig) if f"Rig.{each.name}" not in MAY_DIFFER)
"""Fields of a rig that a table has, too."""


def physics_of(of: object) -> dict[str, Any]:
    """What must be the same of a rig and of a table for the same answers, as plain data.

    of: a rig, or what has its PHYSICS. Fields by name, without those that are as empty as they are
    by default: what was solved before there was such a field stays valid.
    """
    found = {name: _plain(getattr(of, name)) for name in PHYSICS}
    # A laminate is its layers; what it is like depends on the frequency.
    if "laminate" in found["plate"]:
        del found["plate"]["material"], found["plate"]["thickness"]
    found["masses"].sort(key=canonical_json)
    found["names of eras"] = [era["name"] for era in found["eras"]]
    found["eras"] = {era["name"]: era for era in found["eras"]}
    return found | {"fingertip_radius": FINGERTIP_RADIUS}


def fingerprint_of(of: object) -> str:
    """SHA-256 over all that decides what fingers feel, `physics_of` a rig or a table."""
    return hashlib.sha256(canonical_json(physics_of(of)).encode()).hexdigest()


def differences(of: object, rig: Rig) -> list[str]:
    """Keys whose values, of a table, must be those of a rig and are not, but for rounding."""
    return [*_differing("", physics_of(of), physics_of(rig))]


def _plain(value: Any) -> Any:
    """A value in mappings, lists, floats and text, without what may differ and empty defaults."""
    match value:
        case bool() | str() | None:
            return value
        case Real():
            return float(value) + 0.0
        case Mapping():
            return {key: _plain(each) for key, each in value.items()}
        case Iterable():
            return [_plain(each) for each in value]
    kept = [f for f in fields(value) if f"{type(value).__name__}.{f.name}" not in MAY_DIFFER]
    own = [(each, getattr(value, each.name)) for each in kept]
    return {each.name: _plain(held) for each, held in own if held or held != each.default}


def _differing(key: str, own: Any, rigs: Any) -> Iterator[str]:
    """Differences of plain data below a key; a list of another length differs as a whole."""
    if isinstance(own, dict) and isinstance(rigs, dict):
        for name in rigs | own:
            yield from _differing(f"{key}.{name}".lstrip("."), own.get(name), rigs.get(name))
    elif isinstance(own, list) and isinstance(rigs, list) and len(own) == len(rigs):
        for number, pair in enumerate(zip(own, rigs, strict=True)):
            yield from _differing(f"{key}[{number}]", *pair)
    elif own != rigs and not (type(own) is type(rigs) is float and math.isclose(own, rigs)):
        wanted, got = (f"{each:.9g}" if type(each) is float else each for each in (rigs, own))
        yield f"{key} must be {wanted!s:.60}, got {got!s:.60}"


def canonical_json(value: object) -> str:
    """JSON of plain data with sorted keys, the same for 1 and 1.0, and for -0.0 and 0.0."""
    return json.dumps(_plain(value), sort_keys=True, separators=(",", ":"))


RelativePlace = tuple[float, float]
"""Place of an ERA as fractions of the length and the width, 0 to 1."""


@dataclass(frozen=True)
class EraLayout:
    """Places of the ERAs of a rig."""

    name: str
    places: tuple[RelativePlace, ...]

    def positions(self, plate: Plate) -> FloatArray:
        """Positions on a plate [m], (eras, 2)."""
        return np.array(self.places) * [plate.length, plate.width]


FOUR_ERA_LAYOUTS = (
    EraLayout("corners", ((0, 0), (1, 0), (1, 1), (0, 1))),
    EraLayout("mid-edges", ((1 / 2, 0), (1, 1 / 2), (1 / 2, 1), (0, 1 / 2))),
    EraLayout("long edges", ((1 / 4, 0), (3 / 4, 0), (3 / 4, 1), (1 / 4, 1))),
    EraLayout("short edges", ((0, 1 / 4), (1, 1 / 4), (1, 3 / 4), (0, 3 / 4))),
    EraLayout("inset corners", ((1 / 6, 1 / 6), (5 / 6, 1 / 6), (5 / 6, 5 / 6), (1 / 6, 5 / 6))),
    EraLayout("trapezoid", ((0, 0), (1, 0), (3 / 4, 1), (1 / 4, 1))),
    EraLayout("diagonal", ((0, 0), (1 / 3, 1 / 3), (2 / 3, 2 / 3), (1, 1))),
)
"""Layouts of four ERAs; the first is that of the paper's Table 2."""

_OTHERS = (
    EraLayout("centre", ((1 / 2, 1 / 2),)),
    EraLayout("opposite corners", ((0, 0), (1, 1))),
    EraLayout("mid-short-edges", ((0, 1 / 2), (1, 1 / 2))),
    EraLayout("triangle", ((0, 0), (1, 0), (1 / 2, 1))),
    EraLayout("corners and centre", ((0, 0), (1, 0), (1, 1), (0, 1), (1 / 2, 1 / 2))),
    EraLayout(
        "corners and mid-long-edges", ((0, 0), (1 / 2, 0), (1, 0), (1, 1), (1 / 2, 1), (0, 1))
    ),
)


def named_layouts(era_count: int) -> tuple[EraLayout, ...]:
    """The named layouts with a number of ERAs."""
    layouts = (*FOUR_ERA_LAYOUTS, *_OTHERS)
    return tuple(layout for layout in layouts if len(layout.places) == era_count)


def alike(era: OneKind, positions: FloatArray) -> tuple[OneKind, ...]:
    """Copies of an ERA at positions [m] (n, 2), named E1, E2, ..."""
    return tuple(
        replace(era, name=f"E{number}", x=float(x), y=float(y))
        for number, (x, y) in enumerate(positions, start=1)
    )

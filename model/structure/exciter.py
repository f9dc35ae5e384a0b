"""Exciters: a voice coil on the plate, and a magnet on a suspension behind it.

The coil, of mass m_c, moves with the plate, w; the magnet, of mass M, is free at x, or a frame
holds it (`held`). Between them are the suspension, k and c, and the force Bl i of the current. A
voltage amplifier with the output resistance R_g drives the current i = (V - i omega Bl (w - x)) / Z
through Z = R_e + R_g + i omega L. With

    S = k + i omega (c + Bl² / Z),    T = omega² M / (omega² M - S), 1 if the magnet is held,

the force on a clamped plate is F = T Bl V / Z, and the dynamic stiffness is D = S T - omega² m_c.
Far below the resonance of the magnet, omega_m² = k / M, the force falls as omega²; above it, it is
nearly the same at every frequency. A data sheet usually states the resonance of the light coil
against the magnet, f_s (`free`). On a plate, the magnet moves against the coil; its resonance is
f_m = f_s sqrt(m_s / M), with the moving mass m_s of the data sheet.

Known types are in model/data/exciters.toml, with the source of each value.

Not modeled: amplitude dependence of stiffness and damping, heating of the coil (0.39 % of R_e per
kelvin), eddy currents, rocking of the magnet.
"""

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from typing import ClassVar, Self, TypeAlias, TypeVar

import numpy as np

from model.arrays import ComplexArray, FloatArray
from model.errors import MAX_VALUE, InputError, expect_values
from model.structure.attachments import InTime, PointLoad
from model.structure.material import read_catalog
from model.structure.sources import Era, Factor, Source

_MAX_LAG = 0.1  # Bl² L / R², relative to the mass of the magnet


@dataclass(frozen=True)
class Exciter(Source):
    """One exciter whose coil is glued to the plate.

    Stiffness k and damping c refer to the suspension, gains to amplifier and converter.
    """

    UNIT: ClassVar[str] = "V"

    magnet_mass: float  # M [kg]
    coil_mass: float  # m_c [kg]
    force_factor: float  # Bl [N/A]
    resistance: float  # R_e [ohm]
    voltage: float
    """Amplitude at full level [V]."""

    source_resistance: float = 0.0  # R_g [ohm]
    inductance: float = 0.0  # L [H]
    excursion: float = math.inf
    """Largest amplitude of the coil in the magnet [m]; infinite if no data sheet states one."""

    held: bool = False
    """Whether a frame holds the magnet."""

    def __post_init__(self) -> None:
        """Reject values out of range."""
        expect_values(
            self,
            f"exciter {self.name}",
            above="stiffness magnet_mass force_factor resistance voltage",
            at_least="damping coil_mass source_resistance inductance foot",
            finite="x y",
        )
        super().__post_init__()
        if self.force_factor > self.largest_force_factor(self.magnet_mass):
            lag = -self.in_time.inertance
            allowed = _MAX_LAG * self.magnet_mass
            raise InputError(
                f"inductance of exciter {self.name} must let the current follow its back EMF, "
                f"Bl² L / R² at most {_MAX_LAG:g} of the magnet's mass, {1e3 * allowed:.3g} g, got "
                f"{1e3 * lag:.3g} g; check inductance and force_factor"
            )

    def largest_force_factor(self, magnet_mass: float) -> float:
        """The largest Bl [N/A] with a magnet [kg] whose back EMF the current follows."""
        if not self.inductance:
            return MAX_VALUE
        return self.loop_resistance * math.sqrt(_MAX_LAG * magnet_mass / self.inductance)

    @property
    def full_level(self) -> float:
        """Amplitude of its voltage at level 1 [V]."""
        return self.voltage

    @property
    def loop_resistance(self) -> float:
        """R = R_e + R_g [ohm], of coil and amplifier."""
        return self.resistance + self.source_resistance

    @property
    def magnet_frequency(self) -> float:
        """Resonance f_m [Hz] of the magnet with the coil at rest."""
        return math.sqrt(self.stiffness / self.magnet_mass) / (2 * math.pi)

    @property
    def support(self) -> PointLoad:
        """Static equivalent: its mass, and a spring if a frame holds the magnet."""
        load = PointLoad(self.x, self.y, mass=self.coil_mass, foot=self.foot)
        if self.held:
            return replace(load, stiffness=self.stiffness, damping=self.damping)
        return replace(load, mass=self.coil_mass + self.magnet_mass)

    @property
    def in_time(self) -> InTime:
        """Its equations in time, with the current (u - L u' / R) / R, R = R_e + R_g.

        u is the voltage less the back EMF. Force and damping are within (omega L / R)² of the exact
        values: within 0.5 % at 500 Hz for a typical coil.
        """
        total = self.loop_resistance
        delay = self.inductance / total
        return InTime(
            mass=self.coil_mass,
            stiffness=self.stiffness,
            damping=self.damping + self.force_factor**2 / total,
            far_mass=None if self.held else self.magnet_mass,
            by_drive=self.force_factor / total,
            by_rate=-self.force_factor * delay / total,
            inertance=-(self.force_factor**2) * delay / total,
        )

    def force(self, omega: FloatArray) -> ComplexArray:
        """F = T Bl V / Z at full level on a plate at rest [N], its own gain included."""
        w = np.asarray(omega)
        return self._share(w) * self._pull(w)

    def deviating(
        self, omega: FloatArray, stiffness: Factor, damping: Factor
    ) -> tuple[ComplexArray, ComplexArray]:
        """D = S T - omega² m_c [N/m] and T Bl / Z [N/V], by factors of k and c."""
        w = np.asarray(omega)
        spring = self._spring(w, stiffness, damping)
        share = self._share(w, spring)
        by_voltage = share * self.force_factor / self._impedance(w)
        return spring * share - w**2 * self.coil_mass, np.asarray(by_voltage)

    def base(self, omega: FloatArray) -> ComplexArray:
        """Motion Bl V / (Z omega² M) [m] at full level.

        A spring that is stiffer by dS adds the force dS T² (base - w). 0 if a frame holds the
        magnet.
        """
        w = np.asarray(omega)
        if self.held:
            return np.zeros(w.shape, dtype=complex)
        return self._pull(w) / (w**2 * self.magnet_mass)

    @property
    def quality(self) -> float:
        """Q = sqrt(k M) / (c + Bl² / R) of the magnet, with the coil at rest and driven."""
        return math.sqrt(self.stiffness * self.magnet_mass) / self.in_time.damping

    @property
    def largest_gain(self) -> float:
        """The largest magnitude of its gain."""
        return max((size for _, size, _ in self.gains), default=1.0)

    @property
    def largest_force(self) -> float:
        """Force Bl V / R [N] at full level, gain included, far above f_m and without L."""
        return self.in_time.by_drive * self.voltage * self.largest_gain

    def excursion_by(self, omega: FloatArray, moved: ComplexArray) -> ComplexArray:
        """Motion T w [m] of the coil in the magnet, for the plate's motion w (f, ...) [m].

        omega (f,) [rad/s].
        """
        share = self._share(np.asarray(omega))
        return share.reshape(-1, *[1] * (moved.ndim - 1)) * moved

    def loosened(self, share: float) -> Self:
        """Return the exciter with a share of its dynamic stiffness, because of its glue.

        The force decreases with the square root of the share.
        """
        return replace(
            self.varied(stiffness=share, damping=share),
            magnet_mass=share * self.magnet_mass,
            coil_mass=share * self.coil_mass,
            force_factor=math.sqrt(share) * self.force_factor,
        )

    @property
    def fields(self) -> Mapping[str, str]:
        """Suspension, coil, magnet and force factor."""
        names = {kind: kind for kind in ("stiffness", "damping", "magnet_mass", "force_factor")}
        return names | {"bolt_mass": "coil_mass"}

    def slopes(self, omega: FloatArray) -> Mapping[str, tuple[ComplexArray, ComplexArray]]:
        """Derivatives of D and of the force.

        A change dS changes D by T² dS and the force by T² dS `base`. A heavier magnet moves less:
        dT = T (1 - T) dM / M.
        """
        w = np.asarray(omega)
        share = self._share(w)
        force = self.force(w)
        base = self.base(w)

        def by_spring(change: ComplexArray | float) -> tuple[ComplexArray, ComplexArray]:
            stiffness_change = share**2 * change
            return np.asarray(stiffness_change), stiffness_change * base

        electric = 2j * w * self.force_factor**2 / self._impedance(w)
        by_electric, force_by_electric = by_spring(electric)
        by_mass = 1 - share
        return {
            "stiffness": by_spring(self.stiffness),
            "damping": by_spring(np.asarray(1j * w)),
            "force_factor": (by_electric, force_by_electric + force),
            "magnet_mass": (self._spring(w) * share * by_mass, np.asarray(force * by_mass)),
            "bolt_mass": (np.asarray(-(w**2) + 0j), np.zeros(w.shape, dtype=complex)),
        }

    def _impedance(self, w: FloatArray) -> ComplexArray:
        """Z [ohm]."""
        return np.asarray(self.loop_resistance + 1j * w * self.inductance)

    def _spring(
        self, w: FloatArray, stiffness: Factor = 1.0, damping: Factor = 1.0
    ) -> ComplexArray:
        """S [N/m], with stiffness and damping of the suspension multiplied by factors."""
        resistance = damping * self.damping + self.force_factor**2 / self._impedance(w)
        return stiffness * self.stiffness + 1j * w * resistance

    def _share(self, w: FloatArray, spring: ComplexArray | None = None) -> ComplexArray:
        """T; spring: S [N/m] if it differs from the exciter's own."""
        if self.held:
            return np.ones(w.shape, dtype=complex)
        if spring is None:
            spring = self._spring(w)
        inertia = w**2 * self.magnet_mass
        return inertia / (inertia - spring)

    def _pull(self, w: FloatArray) -> ComplexArray:
        """Force Bl V / Z [N] of the current at full level, with the coil at rest."""
        drive = self.voltage * self.gain(w / (2 * np.pi))
        return self.force_factor / self._impedance(w) * drive


Actuator: TypeAlias = Era | Exciter
"""Any actuator, each a `Source`; other kinds are listed here and in `model.rig.actuator_keys`."""

OneKind = TypeVar("OneKind", Era, Exciter, Actuator)
"""Kind of actuator that a function takes and returns."""


@dataclass(frozen=True)
class SheetValue:
    """Value in SI units with its source; with lowest and highest value if it is assumed."""

    value: float
    source: str = ""
    assumed: tuple[float, float] | None = None


@dataclass(frozen=True)
class ExciterType:
    """Exciter type by name; note: information for buyers; values: by rig-file key."""

    name: str
    note: str
    values: Mapping[str, SheetValue]

    @property
    def assumed(self) -> dict[str, tuple[float, float]]:
        """Keys that no source gives, with the lowest and highest value that is likely."""
        return {key: entry.assumed for key, entry in self.values.items() if entry.assumed}


def _known_types() -> Iterator[ExciterType]:
    """Yield the exciter types of the catalog."""
    catalog = read_catalog("exciters.toml")
    for row in catalog["exciters"]:
        values = dict[str, SheetValue]()
        for key, entry in row["values"].items():
            if "assumed" in entry:
                lowest, highest = entry["assumed"]
                values[key] = SheetValue(entry["value"], assumed=(lowest, highest))
            else:
                source = catalog["sources"][entry["source"]] + entry.get("detail", "")
                values[key] = SheetValue(entry["value"], source)
        yield ExciterType(row["name"], row["note"], values)


EXCITER_TYPES: Mapping[str, ExciterType] = {known.name: known for known in _known_types()}
"""Known types by name; the resonance of each is `free`."""

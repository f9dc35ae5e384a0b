"""What a vector of parameters says of a rig: springs, places, masses, losses, gains."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, Self

import numpy as np

from model.arrays import ComplexArray, FloatArray
from model.identification.parameters import Space
from model.rig.rig import Rig
from model.rig.uncertainty import Uncertainty
from model.structure.actuators import Actuator
from model.structure.attachments import Gain, PointLoad
from model.structure.exciter import Exciter
from model.structure.plate import LOSS_FREQUENCY, MAX_LOSS_FACTOR, Plate

_LEAST_MASS = 1e-5  # kg; less is none
_GAIN_STEP = 10.0  # Hz, of a drive that lags; linear between them is right to a thousandth


@dataclass(frozen=True, eq=False)
class Values:
    """A rig's plate with n ERAs, m additional masses and k fingers, in units of the model.

    thickness, modulus: factors; loss_factor at LOSS_FREQUENCY, loss_exponent; stiffness [N/m],
    damping [N s/m], bolt_mass [kg] (n,) and places (n, 2) [m] of the ERAs, bolts of exciters their
    coils; magnet_mass, force_factor (n,): of exciters, factors; supports (q,): of the stiffness of
    each foot, factors; masses (m, 3): kg and x,
    y [m]; mode_shifts, mode_losses: logarithms of the factors of the lowest modes' eigenvalues and
    loss factors beside the rig's; drive_gains (n,), sensor_gains (s,): complex, those of the drives
    beside the rig's; fingers (k, 4): logarithms of FINGER_PARTS; inertia [1/kHz²], drag [1/kHz]
    (n,): of the drives, by which they lag; delays [s]: of the clocks of amplifiers, in the order of
    their names, to the first; none where they agree. Of a plate with form errors, else empty:
    sensor_scales (s,), real, sensor_places (s, 2) [m]: how far sensors are from theirs;
    foreign_mass (c,): in cells, as shares of the plate's and none in all; stretch (3,): of length
    and width, relative,
    and what is added to Poisson's ratio. loss_law: 0 for losses that are hysteretic, 1 for viscous
    ones.
    """

    thickness: float
    modulus: float
    loss_factor: float
    loss_exponent: float
    stiffness: FloatArray
    damping: FloatArray
    bolt_mass: FloatArray
    magnet_mass: FloatArray
    force_factor: FloatArray
    supports: FloatArray
    places: FloatArray
    masses: FloatArray
    mode_shifts: FloatArray
    mode_losses: FloatArray
    drive_gains: ComplexArray
    sensor_gains: ComplexArray
    fingers: FloatArray
    inertia: FloatArray
    drag: FloatArray
    delays: FloatArray
    sensor_scales: FloatArray
    sensor_places: FloatArray
    foreign_mass: FloatArray
    stretch: FloatArray
    loss_law: float

    @classmethod
    def of(cls, rig: Rig, space: Space, x: FloatArray) -> Self:
        """Those of parameters x (p,)."""

        def own(kind: str) -> FloatArray:
            return space.values(x, kind)

        plate, n = rig.plate, len(rig.eras)
        k, c, m = (
            np.array([getattr(era, era.fields[kind]) for era in rig.eras])
            for kind in ("stiffness", "damping", "bolt_mass")
        )
        at = np.array([(era.x, era.y) for era in rig.eras])
        sides = np.array([plate.length, plate.width])
        masses = own("masses").reshape(-1, 3)
        masses[:, 1:] = np.clip(masses[:, 1:] + sides / 2, 0, sides)
        cells = own("foreign_mass")
        loss = plate.loss_factor * np.exp(own("loss")[0]) + own("loss_added")[0]
        return cls(
            thickness=float(np.exp(own("thickness")[0])),
            modulus=float(np.exp(own("modulus")[0])),
            loss_factor=float(np.clip(loss, 0.0, MAX_LOSS_FACTOR)),
            loss_exponent=float(plate.loss_exponent + own("loss_exponent")[0]),
            stiffness=k * np.exp(own("stiffness")),
            damping=c * np.exp(own("damping") + own("damping_each")) + own("damping_added"),
            bolt_mass=m + own("bolt_mass"),
            magnet_mass=np.exp(np.append(own("magnet_mass"), np.zeros(n))[:n]),
            force_factor=np.exp(np.append(own("force_factor"), np.zeros(n))[:n]),
            supports=np.exp(own("supports")),
            places=at + own("place").reshape(n, 2),
            masses=masses,
            mode_shifts=own("mode_shifts"),
            mode_losses=own("mode_losses"),
            drive_gains=np.exp(own("gain") + 1j * own("phase")),
            sensor_gains=np.exp(own("sensor_gain") + 1j * own("sensor_phase")),
            fingers=own("fingers").reshape(-1, 4),
            inertia=own("inertia"),
            drag=own("drag"),
            delays=own("delay"),
            sensor_scales=1 + own("sensor_scale"),
            sensor_places=own("sensor_place").reshape(-1, 2),
            foreign_mass=cells - (cells.mean() if len(cells) else 0.0),
            stretch=np.append(own("side") / sides[: len(own("side"))], own("poisson")),
            loss_law=float(own("loss_law").sum()),
        )

    def sources(self, rig: Rig) -> tuple[Actuator, ...]:
        """The rig's ERAs with their values, where the rig has them and without gains."""
        found: list[Actuator] = []
        for number, era in enumerate(rig.eras):
            new = {
                "stiffness": self.stiffness[number],
                "damping": max(self.damping[number], 0.0),
                "bolt_mass": max(self.bolt_mass[number], 0.0),
            }
            for kind in era.fields.keys() - new:
                new[kind] = getattr(self, kind)[number] * getattr(era, era.fields[kind])
            fields: dict[str, Any] = {era.fields[kind]: float(value) for kind, value in new.items()}
            if isinstance(era, Exciter):
                largest = era.largest_force_factor(fields["magnet_mass"])
                fields["force_factor"] = min(fields["force_factor"], largest)
            found.append(replace(era, gains=(), **fields))
        return tuple(found)

    def lag(self, frequencies: FloatArray) -> ComplexArray:
        """Motion of each drive at frequencies (f,) [Hz] relative to a slow one, (f, n).

        1 / (1 - inertia f² + i drag f), f in kilohertz: of an actuator with a resonance at
        1 / sqrt(inertia) and a damping ratio of drag / (2 sqrt(inertia)).
        """
        f = 1e-3 * np.asarray(frequencies)[:, None]
        return np.asarray(1 / (1 - self.inertia * f**2 + 1j * self.drag * f))


def plate_with(plate: Plate, values: Values) -> Plate:
    """The plate with identified thickness, modulus, losses and modes."""
    count = max(len(plate.mode_deviations), len(values.mode_shifts))
    deviations = np.zeros((count, 2))
    deviations[: len(plate.mode_deviations)] = np.reshape(plate.mode_deviations, (-1, 2))
    deviations[: len(values.mode_shifts)] += np.column_stack(
        [values.mode_shifts, values.mode_losses]
    )
    return replace(
        plate.scaled(modulus=values.modulus, thickness=values.thickness),
        loss_factor=values.loss_factor,
        loss_exponent=values.loss_exponent,
        mode_deviations=tuple((float(a), float(b)) for a, b in deviations if deviations.any()),
    )


def rig_with(rig: Rig, values: Values, uncertainty: Uncertainty) -> Rig:
    """The rig with identified values; additional masses come after its own."""
    places = np.clip(values.places, 0, [rig.plate.length, rig.plate.width])
    eras = tuple(
        replace(
            era,
            x=float(places[number, 0]),
            y=float(places[number, 1]),
            gains=_gains(rig, values, number),
        )
        for number, era in enumerate(values.sources(rig))
    )
    masses = list(rig.masses)
    for foot, factor in zip(rig.feet, values.supports.tolist(), strict=True):
        masses[foot] = replace(masses[foot], stiffness=factor * masses[foot].stiffness)
    return replace(
        rig,
        plate=plate_with(rig.plate, values),
        laminate=rig.laminate
        and rig.laminate.scaled(modulus=values.modulus, thickness=values.thickness),
        eras=eras,
        masses=(*masses, *additional_masses(values)),
        uncertainty=uncertainty,
    )


def additional_masses(values: Values) -> Sequence[PointLoad]:
    """The masses that were found on the plate, without those that weigh nothing."""
    return [
        PointLoad(float(x), float(y), mass=float(mass))
        for mass, x, y in values.masses
        if mass > _LEAST_MASS
    ]


def _gains(rig: Rig, values: Values, number: int) -> tuple[Gain, ...]:
    """Measured gains times what was identified; of an ERA without any at one frequency.

    Over the rig's frequencies where the drive lags, and where the clock of its amplifier does.
    """
    era = rig.eras[number]
    lags, delay = values.inertia[number] or values.drag[number], _delay(era.name, rig, values)
    if values.drive_gains[number] == 1 and not (lags or delay):
        return era.gains
    before = era.gains or ((LOSS_FREQUENCY, 1.0, 0.0),)
    if lags or (delay and not era.gains):
        low, high = rig.limits.frequency_min, rig.limits.frequency_max
        count = 1 + int(np.ceil((high - low) / _GAIN_STEP))
        before = tuple((float(f), 1.0, 0.0) for f in np.linspace(low, high, count))
    f = np.array([f for f, *_ in before])
    late = np.exp(-2j * np.pi * f * delay)
    factors = values.drive_gains[number] * values.lag(f)[:, number] * late
    return tuple(
        (f, magnitude * float(abs(factor)), turned + float(np.angle(factor)))
        for (f, magnitude, turned), factor in zip(before, factors.tolist(), strict=True)
    )


def _delay(era: str, rig: Rig, values: Values) -> float:
    """By which an ERA is late with its amplifier's clock [s]."""
    if not len(values.delays):
        return 0.0
    names = sorted({channel.amplifier for channel in rig.wiring.values()})
    return float(values.delays[names.index(rig.wiring[era].amplifier)])

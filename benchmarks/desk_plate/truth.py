"""What a plate on the desk really is, drawn within what a rig's drawing leaves open."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from model.arrays import ComplexArray, FloatArray
from model.rig.rig import Rig
from model.rig.rig_file import parse_mesh
from model.structure.attachments import Era
from model.structure.plate import Plate

MESH = "16x12 Q3"
"""Elements of high order: another solver than the polynomials of a table."""

_RESONANCES = 550.0, 800.0  # Hz, of actuators; above the played range, but felt in its phases
_AMPLIFIERS = 2.5e3, 3.5e3  # Hz, of filters before exciters; far above the band
_MAGNET = 0.05
_RATIOS = 0.2, 0.4  # of their damping
_FLAT, _LEAST_LAG = 0.7, math.radians(3)  # ratio of a damping that lets gains be flat
_PLACE = 1e-3  # m
_BOLT = 0.008  # kg


@dataclass(frozen=True)
class Actuator:
    """The motion of an ERA's base by a sample: g w² / (s² + 2 zeta w s + w²) full strokes.

    resonance w / 2 pi [Hz], damping ratio zeta, gain g.
    """

    resonance: float
    ratio: float
    gain: float

    def response(self, frequencies: FloatArray) -> ComplexArray:
        """Full strokes by full scale at frequencies [Hz]."""
        x = np.asarray(frequencies) / self.resonance
        return np.asarray(self.gain / (1 - x**2 + 2j * self.ratio * x))


@dataclass(frozen=True)
class Truth:
    """A plate on its ERAs as it is: a rig without measured gains, and an actuator of each ERA."""

    rig: Rig
    actuators: tuple[Actuator, ...]

    def as_json(self) -> Mapping[str, object]:
        """Its parameters, as those that `era calibrate` finds, for programs."""
        plate = self.rig.plate
        return {
            "thickness_m": plate.thickness,
            "flexural_rigidity_n_m": plate.flexural_rigidity,
            "loss_factor": plate.loss_factor,
            "eras": {
                era.name: {
                    "at_m": [era.x, era.y],
                    **{kind: getattr(era, field) for kind, field in era.fields.items()},
                    "resonance_hz": actuator.resonance,
                    "damping_ratio": actuator.ratio,
                    "gain": actuator.gain,
                }
                for era, actuator in zip(self.rig.eras, self.actuators, strict=True)
            },
        }


def draw_truth(rig: Rig, *, seed: int, mesh: str = MESH) -> Truth:
    """Draw a plate of a rig: by the rig's uncertainty, with places, bolts and actuators of its own.

    Places are off by 1 mm (standard deviation), bolts weigh up to 8 g more, magnets of exciters
    differ by 5 %.
    """
    rng = np.random.default_rng(seed)
    std = rig.uncertainty

    def relative(deviation: float) -> float:
        return float(max(0.05, 1 + deviation * rng.standard_normal()))

    plate = rig.plate.scaled(thickness=relative(std.thickness))
    loss = min(plate.loss_factor * std.damping ** rng.standard_normal(), 0.5)
    plate = replace(plate, loss_factor=float(loss))
    damping = std.damping ** rng.standard_normal()
    eras = []
    for era in rig.eras:
        x, y = _near((era.x, era.y), plate, rng)
        changes: dict[str, Any] = {
            "x": x,
            "y": y,
            "stiffness": era.stiffness * relative(std.stiffness),
            "damping": float(era.damping * damping * relative(std.stiffness)),
        }
        if isinstance(era, Era):
            changes["bolt_mass"] = era.bolt_mass + float(rng.uniform(0, _BOLT))
        else:
            changes["magnet_mass"] = era.magnet_mass * relative(_MAGNET)
        eras.append(replace(era, gains=(), **changes))
    actuators = tuple(
        Actuator(
            float(rng.uniform(*(_RESONANCES if isinstance(era, Era) else _AMPLIFIERS))),
            float(rng.uniform(*_RATIOS)),
            relative(std.gain),
        )
        for era in eras
    )
    return Truth(
        replace(rig, plate=plate, eras=tuple(eras), mesh=parse_mesh(mesh, plate)), actuators
    )


def as_built(rig: Rig, *, mesh: str) -> Truth:
    """The plate that a rig describes, solved on another mesh; its gains are those of actuators.

    Of each the magnitude, and the phase amid the rig's band, which no lag makes positive: all are
    late by what the earliest has too much, and by 3 degrees.
    """
    middle = math.sqrt(rig.limits.frequency_min * rig.limits.frequency_max)
    gains = [complex(era.gain(np.array([middle]))[0]) for era in rig.eras]
    phases = np.angle(gains)
    lags = np.tan(phases.max() - phases + _LEAST_LAG)
    # tan(lag) = 2 zeta x / (1 - x²)
    x = (np.sqrt(_FLAT**2 + lags**2) - _FLAT) / lags
    actuators = tuple(
        Actuator(middle / of_resonance, _FLAT, abs(gain) * _flatness(of_resonance))
        for of_resonance, gain in zip(x.tolist(), gains, strict=True)
    )
    eras = tuple(replace(era, gains=()) for era in rig.eras)
    return Truth(replace(rig, eras=eras, mesh=parse_mesh(mesh, rig.plate)), actuators)


def _flatness(x: float) -> float:
    """What an actuator lacks of its gain at a share x of its resonance, inverted."""
    return math.hypot(1 - x**2, 2 * _FLAT * x)


def _near(place: Sequence[float], plate: Plate, rng: np.random.Generator) -> tuple[float, float]:
    """A place beside another, on the plate."""
    found = np.abs(np.asarray(place) + _PLACE * rng.standard_normal(2))
    sides = np.array([plate.length, plate.width])
    x, y = np.where(found > sides, 2 * sides - found, found).tolist()
    assert math.isfinite(x + y)
    return x, y

"""Imperfections of a bench: of its amplifiers, its plate and ERAs, and the fingers on it.

Amplifiers have gain and phase errors, delays, and inexact crystals; plate and ERAs differ from the
rig's, ERAs are displaced, and finger loads vary. Each ERA adds a second harmonic
(`sim.plant.era_motions`). Channel errors do not drift.
"""

import cmath
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from zlib import crc32

import numpy as np

from drivers.protocol.definition import CLOCK_TURN
from model.answer.stimulus import Finger
from model.arrays import ComplexArray, FloatArray, Point
from model.errors import InputError
from model.rig.rig import Channel, Rig
from model.rig.rig_mesh import mesh_of
from model.spectral.plate_mesh import PlateMesh
from model.structure.exciter import Actuator
from model.structure.fingertips import Fingertip, FingertipLoad, fingertip_loads
from model.structure.plate import Plate
from model.study.exact_plates import Plates, draw_plates
from model.vibration import finer_mesh
from sim.amplifier.amplifier_clock import Crystal

_MAX_LOSS_FACTOR = 0.99
_MIN_FACTOR = 0.05  # of a normal draw about 1, which may be negative
_MAX_CRYSTAL_ERROR = 50e-6  # 50 ppm
_WARM_UP = 1e-6  # 1/s; a crystal drifts by 1 ppm/s up or down


@dataclass(frozen=True)
class ChannelErrors:
    """Errors of a channel: gain factor, phase [rad].

    harmonic: second harmonic of its ERA's motion, relative to it (`sim.plant.era_motions`).
    """

    gain: float = 1.0
    phase: float = 0.0
    harmonic: complex = 0j

    def __post_init__(self) -> None:
        """Check the ranges."""
        if not all(cmath.isfinite(value) for value in (self.gain, self.phase, self.harmonic)):
            raise InputError(f"{self}: gain, phase and harmonic must be finite numbers")
        if self.gain < 0:
            raise InputError(f"{self}: gain must not be negative")

    @property
    def factor(self) -> complex:
        """Gain and phase as one complex factor."""
        return cmath.rect(self.gain, self.phase)


@dataclass(frozen=True)
class PlateErrors:
    """A plate on its ERAs relative to the rig's: factors, by default 1.

    stiffness: by ERA; places: displacement of each ERA [m]; era_damping: of all ERAs; feet: of the
    stiffness of each foot, by index among the rig's masses; mesh: for solving, None for the rig's;
    modes: eigenvalue and squared size (2, m) of the lowest elastic modes.
    """

    thickness: float = 1.0
    modulus: float = 1.0
    loss_factor: float = 1.0
    era_damping: float = 1.0
    stiffness: Mapping[str, float] = field(default_factory=dict)
    places: Mapping[str, Point] = field(default_factory=dict)
    feet: Mapping[int, float] = field(default_factory=dict)
    mesh: PlateMesh | None = None
    modes: Sequence[Sequence[float]] = field(default_factory=lambda: [[], []])

    def realised(self, rig: Rig) -> Rig:
        """The rig whose plate and ERAs have these errors."""
        eras = tuple([self._realised_era(era, rig.plate) for era in rig.eras])
        masses = list(rig.masses)
        for number, factor in self.feet.items():
            foot = masses[number]
            masses[number] = replace(foot, stiffness=factor * foot.stiffness)
        return replace(
            rig,
            plate=self._realised_plate(rig.plate),
            eras=eras,
            masses=tuple(masses),
            mesh=self.mesh or rig.mesh,
        )

    def _realised_era(self, era: Actuator, plate: Plate) -> Actuator:
        """An ERA with its errors; a displacement ends at the edge of the plate."""
        stiffness = self.stiffness.get(era.name, 1.0)
        dx, dy = self.places.get(era.name, (0.0, 0.0))
        x = float(np.clip(era.x + dx, 0.0, plate.length))
        y = float(np.clip(era.y + dy, 0.0, plate.width))
        varied = era.varied(stiffness=stiffness, damping=self.era_damping)
        return replace(varied, x=x, y=y)

    def _realised_plate(self, plate: Plate) -> Plate:
        """A plate with its errors."""
        loss_factor = min(self.loss_factor * plate.loss_factor, _MAX_LOSS_FACTOR)
        surface = plate.surface
        if surface:
            _, squared_sizes = self.modes
            surface = replace(surface, sizes=tuple(map(math.sqrt, squared_sizes)))
        return replace(
            plate.scaled(thickness=self.thickness, modulus=self.modulus),
            loss_factor=loss_factor,
            mode_deviations=self._mode_deviations(plate),
            surface=surface,
        )

    def _mode_deviations(self, plate: Plate) -> tuple[tuple[float, float], ...]:
        """The deviations of a plate's modes, with the errors of their eigenvalues added."""
        eigenvalues, _ = self.modes
        stated = plate.mode_deviations
        padded_stated = [*stated, *[(0.0, 0.0)] * len(eigenvalues)]
        padded_errors = [*eigenvalues, *[1.0] * len(stated)]
        deviations = []
        for (log_eigenvalue, log_loss_factor), error in zip(
            padded_stated, padded_errors, strict=True
        ):
            deviations.append((log_eigenvalue + math.log(error), log_loss_factor))
        return tuple(deviations)


@dataclass(frozen=True)
class Imperfections:
    """Imperfections of a bench, by default none.

    channels: errors by channel; delays [s]: from a command to the base motion, by amplifier;
    crystals: of the clocks, by amplifier; plate: errors of the plate and its ERAs; fingertip:
    log-normal spread of a finger's load; seed: random seed of the loads.
    """

    channels: Mapping[Channel, ChannelErrors] = field(default_factory=dict)
    delays: Mapping[str, float] = field(default_factory=dict)
    crystals: Mapping[str, Crystal] = field(default_factory=dict)
    plate: PlateErrors = field(default_factory=PlateErrors)
    fingertip: float = 0.0
    seed: int = 0

    def __post_init__(self) -> None:
        """Check that every delay is finite and not negative."""
        for name, delay in self.delays.items():
            if not (math.isfinite(delay) and delay >= 0):
                raise InputError(
                    f"delay of {name} must be finite and not negative, got {delay:g} s"
                )

    def check(self, rig: Rig) -> None:
        """Raise InputError for amplifiers and channels that the rig does not have."""
        wired = set(rig.wiring.values())
        for channel in self.channels:
            if channel not in wired:
                raise InputError(
                    f"imperfections: no ERA is wired to channel {channel.number} of amplifier "
                    f"{channel.amplifier}"
                )
        for name in (*self.delays, *self.crystals):
            if name not in rig.amplifiers:
                raise InputError(
                    f"imperfections: amplifier must be one of {', '.join(rig.amplifiers)}, "
                    f"got {name}"
                )

    def errors_of(self, era: str, rig: Rig) -> ChannelErrors:
        """Errors of the channel to which an ERA is wired."""
        return self.channels.get(rig.wiring[era], ChannelErrors())

    def crystal_of(self, amplifier: str) -> Crystal:
        """The crystal of an amplifier."""
        return self.crystals.get(amplifier, Crystal())

    def load_of(self, finger: str, fingertip: Fingertip) -> Fingertip:
        """The load of a finger by id, always the same."""
        if self.fingertip == 0:
            return fingertip
        rng = np.random.default_rng([self.seed, crc32(finger.encode())])
        return fingertip.multiplied(math.exp(self.fingertip * rng.standard_normal()))

    def resting(self, rig: Rig, fingers: Sequence[Finger]) -> list[FingertipLoad]:
        """Fingers as loads of the plate; empty if the rig's fingertips are weightless."""
        positions = [finger.at for finger in fingers]
        factors = [finger.load for finger in fingers]
        nominal_loads = fingertip_loads(rig.fingertip, positions, factors)
        loads = []
        for number, nominal in enumerate(nominal_loads):
            fingertip = self.load_of(str(number), nominal.fingertip)
            loads.append(replace(nominal, fingertip=fingertip))
        return loads

    def factors(self, rig: Rig) -> ComplexArray:
        """Gain and phase of each ERA's channel, (eras,)."""
        return np.array([self.errors_of(era.name, rig).factor for era in rig.eras])


def draw_imperfections(rig: Rig, *, seed: int = 0) -> Imperfections:
    """Draw the plate, ERAs, channels and fingers of a rig from its tolerances.

    Feet, loss factor and damping are log-normal, all other errors normal. Crystals are within
    50 ppm and initially drift by 1 ppm/s. The plate is solved on another mesh than the rig's, as
    accurate as `mesh: auto`.
    """
    # One generator for each group of errors: a new kind of error leaves the draws of a seed as
    # they are. The order of the draws is part of the result.
    rng = np.random.default_rng(seed)
    std = rig.uncertainty
    gains_and_phases = {
        channel: ChannelErrors(
            _factor(rng, std.gain), math.radians(std.phase_deg) * rng.standard_normal()
        )
        for channel in rig.wiring.values()
    }
    thickness = _factor(rng, std.thickness)
    loss_factor = std.damping ** rng.standard_normal()
    era_damping = std.damping ** rng.standard_normal()
    stiffness = {era.name: _factor(rng, std.stiffness) for era in rig.eras}

    rng_of_details = np.random.default_rng([seed, crc32(b"modulus, places, harmonics")])
    modulus = _factor(rng_of_details, std.elasticity)
    displacements = std.place * rng_of_details.standard_normal((len(rig.eras), 2))
    channels = _with_harmonics(gains_and_phases, std.harmonic, rng_of_details)

    rng_of_feet = np.random.default_rng([seed, crc32(b"feet")])
    feet = np.exp(std.supports * rng_of_feet.standard_normal(len(rig.feet)))
    drawn_modes = draw_plates(rng_of_feet, std, of=rig, count=1, contact_count=0).modes[0]
    plate = PlateErrors(
        thickness=thickness,
        modulus=modulus,
        loss_factor=loss_factor,
        era_damping=era_damping,
        stiffness=stiffness,
        places=_places_by_era(rig, displacements),
        feet=_factors_by_foot(rig, feet),
        mesh=_other_mesh(rig),
        modes=drawn_modes.tolist(),
    )
    return _with_crystals_and_fingers(rig, channels, plate, seed)


def draw_of_ensemble(rig: Rig, *, seed: int) -> Imperfections:
    """Draw a plate like those used to check promises (`model.study.exact_plates`).

    Like `draw_imperfections`, plus a common gain error of all channels.
    """
    rng = np.random.default_rng(seed)
    drawn = draw_plates(rng, rig.uncertainty, of=rig, count=1, contact_count=0)
    stiffness = {}
    for era, factor in zip(rig.eras, drawn.stiffness[0].tolist(), strict=True):
        stiffness[era.name] = max(factor, _MIN_FACTOR)
    plate = PlateErrors(
        thickness=max(float(drawn.thickness[0]), _MIN_FACTOR),
        modulus=max(float(drawn.modulus[0]), _MIN_FACTOR),
        loss_factor=float(drawn.loss[0]),
        era_damping=float(drawn.damping[0]),
        stiffness=stiffness,
        places=_places_by_era(rig, drawn.places[0]),
        feet=_factors_by_foot(rig, drawn.feet[0]),
        mesh=_other_mesh(rig),
        modes=drawn.modes[0].tolist(),
    )
    return _with_crystals_and_fingers(rig, _channels_of(drawn, rig), plate, seed)


def _factor(rng: np.random.Generator, deviation: float) -> float:
    """Draw a factor about 1 with a standard deviation."""
    return max(_MIN_FACTOR, 1 + deviation * rng.standard_normal())


def _with_harmonics(
    channels: Mapping[Channel, ChannelErrors], deviation: float, rng: np.random.Generator
) -> dict[Channel, ChannelErrors]:
    """Channels with second harmonics drawn from a complex normal distribution."""
    parts = rng.standard_normal((2, len(channels))) * (deviation * math.sqrt(0.5))
    real_parts, imaginary_parts = parts.tolist()
    with_harmonics = {}
    for (channel, errors), real, imaginary in zip(
        channels.items(), real_parts, imaginary_parts, strict=True
    ):
        with_harmonics[channel] = replace(errors, harmonic=complex(real, imaginary))
    return with_harmonics


def _channels_of(drawn: Plates, rig: Rig) -> dict[Channel, ChannelErrors]:
    """The errors of all channels on the first of the drawn plates."""
    gains = drawn.gain[0].tolist()
    harmonics = drawn.harmonic[0].tolist()
    channels = {}
    for era, factor, harmonic in zip(rig.eras, gains, harmonics, strict=True):
        gain, phase = cmath.polar(factor)
        channels[rig.wiring[era.name]] = ChannelErrors(gain, phase, harmonic)
    return channels


def _places_by_era(rig: Rig, displacements: FloatArray) -> dict[str, Point]:
    places = {}
    for era, (dx, dy) in zip(rig.eras, displacements.tolist(), strict=True):
        places[era.name] = (dx, dy)
    return places


def _factors_by_foot(rig: Rig, factors: FloatArray) -> dict[int, float]:
    return dict(zip(rig.feet, factors.tolist(), strict=True))


def _with_crystals_and_fingers(
    rig: Rig, channels: Mapping[Channel, ChannelErrors], plate: PlateErrors, seed: int
) -> Imperfections:
    """Imperfections with fingers, and with crystals of amplifiers switched on at random times."""
    rng = np.random.default_rng([seed, crc32(b"crystals")])
    crystals = {}
    for name in rig.amplifiers:
        error = rng.uniform(-_MAX_CRYSTAL_ERROR, _MAX_CRYSTAL_ERROR)
        warm_up = rng.choice((-_WARM_UP, _WARM_UP))
        ahead = rng.uniform(0, CLOCK_TURN)
        crystals[name] = Crystal(error=error, warm_up=warm_up, ahead=ahead)
    fingertip = rig.uncertainty.fingertip
    return Imperfections(channels, crystals=crystals, plate=plate, fingertip=fingertip, seed=seed)


def _other_mesh(rig: Rig) -> PlateMesh:
    """A mesh at least as accurate as `mesh: auto` that differs from the rig's."""
    frequency_max = rig.limits.frequency_max
    stiffness = rig.largest_stiffness
    auto_mesh = mesh_of("auto", rig.plate, frequency_max=frequency_max, stiffness=stiffness)
    mesh = finer_mesh(rig.plate, auto_mesh, frequency_max=frequency_max)
    if mesh == rig.mesh:
        mesh = finer_mesh(rig.plate, mesh, frequency_max=frequency_max)
    return mesh

"""Imperfections of a bench: of its amplifiers, its plate and ERAs, and the fingers on it.

Amplifiers have gain and phase errors, delays, and inexact crystals; plate and ERAs differ from the
rig's, ERAs are displaced, and finger loads vary. Each ERA adds a second harmonic: a share of each
tone's amplitude at twice its frequency and phase, with its own angle. Not modelled: sums and
differences of several tones, harmonics of signals, other distortion, and drifting errors of
channels.
"""

import cmath
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from zlib import crc32

import numpy as np

from drivers.playing import Voice
from drivers.protocol.definition import CLOCK_TURN
from model.answer.answer import Layer
from model.answer.stimulus import Finger
from model.arrays import ComplexArray, FloatArray, Point
from model.errors import InputError
from model.rig.rig import Channel, Rig
from model.rig.rig_file import mesh_of
from model.spectral.modes import PlateMesh
from model.structure.attachments import Fingertip, FingertipLoad, fingertip_loads
from model.structure.exciter import Actuator
from model.study.exact_plates import draw_plates
from model.transients.base_motion import BaseEnvelope, Motion, Term, along_lines, raised_cosine
from model.vibration import Tone, finer_mesh
from sim.amplifier.readings import Crystal, StraightClock

_MAX_LOSS_FACTOR = 0.99
_MIN_FACTOR = 0.05  # of a normal draw about 1, which may be negative
_CRYSTAL, _WARM_UP = 50e-6, 1e-6  # 50 ppm, and 1 ppm/s either way


@dataclass(frozen=True)
class ChannelErrors:
    """Errors of a channel: gain factor, phase [rad].

    harmonic: second harmonic of its ERA's motion, relative to it (`sim.plant.imperfections`).
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

        def of(era: Actuator) -> Actuator:
            x, y = np.add((era.x, era.y), self.places.get(era.name, (0.0, 0.0)))
            varied = era.varied(
                stiffness=self.stiffness.get(era.name, 1.0), damping=self.era_damping
            )
            return replace(
                varied,
                x=float(np.clip(x, 0.0, rig.plate.length)),
                y=float(np.clip(y, 0.0, rig.plate.width)),
            )

        stated, surface, (squares, sizes) = rig.plate.mode_deviations, rig.plate.surface, self.modes
        plate = replace(
            rig.plate.scaled(thickness=self.thickness, modulus=self.modulus),
            loss_factor=min(self.loss_factor * rig.plate.loss_factor, _MAX_LOSS_FACTOR),
            mode_deviations=tuple(
                (a + math.log(square), b)
                for (a, b), square in zip(
                    [*stated, *[(0.0, 0.0)] * len(squares)],
                    [*squares, *[1.0] * len(stated)],
                    strict=True,
                )
            ),
            surface=surface and replace(surface, sizes=tuple(map(math.sqrt, sizes))),
        )
        masses = list(rig.masses)
        for number, factor in self.feet.items():
            masses[number] = replace(masses[number], stiffness=factor * masses[number].stiffness)
        return replace(
            rig,
            plate=plate,
            eras=tuple(map(of, rig.eras)),
            masses=tuple(masses),
            mesh=self.mesh or rig.mesh,
        )


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
        places, loads = [each.at for each in fingers], [each.load for each in fingers]
        return [
            replace(each, fingertip=self.load_of(str(number), each.fingertip))
            for number, each in enumerate(fingertip_loads(rig.fingertip, places, loads))
        ]

    def factors(self, rig: Rig) -> ComplexArray:
        """Gain and phase of each ERA's channel, (eras,)."""
        return np.array([self.errors_of(era.name, rig).factor for era in rig.eras])


def draw_imperfections(rig: Rig, *, seed: int = 0) -> Imperfections:
    """Draw the plate, ERAs, channels and fingers of a rig within its uncertainty, all normal.

    Feet log-normal. Crystals are within 50 ppm, and drift by 1 ppm/s at first. The plate is solved
    on another mesh than the rig's, as accurate as `mesh: auto`.
    """
    rng = np.random.default_rng(seed)
    std = rig.uncertainty

    def relative(deviation: float) -> float:
        return max(_MIN_FACTOR, 1 + deviation * rng.standard_normal())

    channels = {
        channel: ChannelErrors(
            relative(std.gain), math.radians(std.phase_deg) * rng.standard_normal()
        )
        for channel in rig.wiring.values()
    }
    plate = PlateErrors(
        thickness=relative(std.thickness),
        loss_factor=std.damping ** rng.standard_normal(),
        era_damping=std.damping ** rng.standard_normal(),
        stiffness={era.name: relative(std.stiffness) for era in rig.eras},
        mesh=_other_mesh(rig),
    )
    # A separate generator, so that other draws of a seed do not change.
    rng = np.random.default_rng([seed, crc32(b"modulus, places, harmonics")])
    of_feet = np.random.default_rng([seed, crc32(b"feet")])
    plate = replace(
        plate,
        modulus=relative(std.elasticity),
        places=_places(rig, std.place * rng.standard_normal((len(rig.eras), 2))),
        feet=_feet(rig, np.exp(std.supports * of_feet.standard_normal(len(rig.feet)))),
        modes=draw_plates(of_feet, std, of=rig, count=1, contact_count=0).modes[0].tolist(),
    )
    real, imaginary = rng.standard_normal((2, len(channels))) * (std.harmonic * math.sqrt(0.5))
    channels = {
        channel: replace(errors, harmonic=complex(*both))
        for (channel, errors), both in zip(
            channels.items(), zip(real, imaginary, strict=True), strict=True
        )
    }
    return _drawn(rig, channels, plate, seed)


def _places(rig: Rig, off: FloatArray) -> dict[str, Point]:
    return {era.name: (x, y) for era, (x, y) in zip(rig.eras, off.tolist(), strict=True)}


def _feet(rig: Rig, factors: FloatArray) -> dict[int, float]:
    return dict(zip(rig.feet, factors.tolist(), strict=True))


def draw_of_ensemble(rig: Rig, *, seed: int) -> Imperfections:
    """Draw a plate like those used to check promises (`model.study.exact_plates`).

    Like `draw_imperfections`, plus a common gain error of all channels.
    """
    drawn = draw_plates(
        np.random.default_rng(seed),
        rig.uncertainty,
        of=rig,
        count=1,
        contact_count=0,
    )
    plate = PlateErrors(
        thickness=max(float(drawn.thickness[0]), _MIN_FACTOR),
        modulus=max(float(drawn.modulus[0]), _MIN_FACTOR),
        places=_places(rig, drawn.places[0]),
        loss_factor=float(drawn.loss[0]),
        era_damping=float(drawn.damping[0]),
        stiffness={
            era.name: max(factor, _MIN_FACTOR)
            for era, factor in zip(rig.eras, drawn.stiffness[0].tolist(), strict=True)
        },
        feet=_feet(rig, drawn.feet[0]),
        mesh=_other_mesh(rig),
        modes=drawn.modes[0].tolist(),
    )
    channels = {
        rig.wiring[era.name]: ChannelErrors(*cmath.polar(gain), harmonic)
        for era, gain, harmonic in zip(
            rig.eras, drawn.gain[0].tolist(), drawn.harmonic[0].tolist(), strict=True
        )
    }
    return _drawn(rig, channels, plate, seed)


def _drawn(
    rig: Rig, channels: Mapping[Channel, ChannelErrors], plate: PlateErrors, seed: int
) -> Imperfections:
    """Imperfections with the amplifiers' crystals, switched on at arbitrary times."""
    rng = np.random.default_rng([seed, crc32(b"crystals")])
    crystals = {
        name: Crystal(
            error=rng.uniform(-_CRYSTAL, _CRYSTAL),
            warm_up=rng.choice((-_WARM_UP, _WARM_UP)),
            ahead=rng.uniform(0, CLOCK_TURN),
        )
        for name in rig.amplifiers
    }
    return Imperfections(
        channels, crystals=crystals, plate=plate, fingertip=rig.uncertainty.fingertip, seed=seed
    )


def _other_mesh(rig: Rig) -> PlateMesh:
    """A mesh as accurate as `mesh: auto` or more, and not the rig's."""
    highest = rig.limits.frequency_max
    mesh = finer_mesh(
        rig.plate,
        mesh_of("auto", rig.plate, frequency_max=highest, stiffness=rig.largest_stiffness),
        frequency_max=highest,
    )
    return mesh if mesh != rig.mesh else finer_mesh(rig.plate, mesh, frequency_max=highest)


def realised(motion: Motion, errors: ChannelErrors) -> list[Term]:
    """Base motion with the gain and phase errors of its channel."""
    return [
        term._replace(c0=errors.factor * term.c0, c1=errors.factor * term.c1) for term in motion
    ]


def of_voices(voices: Sequence[Voice], share: complex) -> list[Voice]:
    """Second harmonics of the voices of a channel; empty for share 0."""
    if not share:
        return []
    found = []
    for voice in voices:
        way = voice.transition
        first, last, *knots = (_doubled(each, share) for each in (way.first, way.last, *way.knots))
        doubled = replace(way, first=first, last=last, knots=tuple(knots))
        found.append(replace(voice, frequency=2 * voice.frequency, transition=doubled))
    return found


def of_layer(layer: Layer, shares: Mapping[str, complex]) -> list[Layer]:
    """Second harmonics of a starting layer; shares: by ERA, empty if all are 0."""
    if not any(shares.values()):
        return []
    return [
        replace(
            voice,
            excitation={
                name: Tone.from_phasor(2 * tone.frequency, _doubled(tone.phasor, shares[name]))
                for name, tone in voice.excitation.items()
            },
            onset=voice.onset
            and {name: _of_envelope(each, shares[name]) for name, each in voice.onset.items()},
        )
        for voice in layer.voices
    ]


def _of_envelope(envelope: BaseEnvelope, share: complex) -> BaseEnvelope:
    start, *knots = (_doubled(value, share) for value in (envelope.start, *envelope.knots))
    return BaseEnvelope(2 * envelope.frequency, start, tuple(knots), envelope.step)


def _doubled(amplitude: complex, share: complex) -> complex:
    """Amplitude of a second harmonic."""
    return share * amplitude * amplitude / abs(amplitude) if amplitude else 0j


def motion_of(
    voices: Sequence[Voice], clock: StraightClock, *, stroke: float, delay: float = 0.0
) -> list[Term]:
    """Return the motion of a base due to its channel's voices; level 1 is the stroke [m].

    clock: amplifier clock for the angles; delay: of the base behind its voices [s].
    """
    return [term for voice in voices for term in _terms(voice, clock, stroke, delay)]


def _terms(voice: Voice, clock: StraightClock, stroke: float, delay: float) -> tuple[Term, ...]:
    way, omega = voice.transition, 2 * math.pi * voice.frequency
    factor = stroke * cmath.exp(1j * omega * clock.at(way.start))
    start, omega = way.start + delay, omega * clock.pace
    if not way.knots:
        return raised_cosine(start, way.step, omega, factor * way.first, factor * way.last)
    values = [factor * value for value in (way.first, *way.knots, way.last)]
    return along_lines(start, way.step, omega, values)

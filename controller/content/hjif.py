"""HJIF, the interchange format of ISO/IEC 23090-31 (MPEG haptics), of 2023.

Of profile Main the bands Transient, VectorialWave and Curve; bands of wavelets are refused. One
channel of vibration is read. Intensity is the amplitude, as the reference encoder writes that of
AHAP; a wave of another form than a sine counts by its root mean square.
"""

import math
import re
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import Field

from controller.content.format import ContentFormat, refusal, too_much
from controller.content.json_file import ContentSection, Entries, read_json, unknown_keys
from controller.content.mixing import Segment, between, mixed
from controller.content.pattern import Pattern, Transient
from controller.content.sharpness import MAX_HZ, MIN_HZ, sharpness_of
from controller.content.wav import course_of
from model.arrays import FloatArray
from model.config.document import KeyPath
from model.config.fields import Validation
from model.quantities import counted

_VIBRATION = ("Other", "Acceleration", "Vibration", "Vibrotactile", "Vibrotactile Texture")
_RATE = 2000  # Hz, at which a curve is sampled
_MAX_CURVES = 600.0  # s; of all curves of a file together, each a second longer
_TRANSIENT_HZ = 90.0
"""Frequency of a transient that has none, as the reference encoder has it [Hz]."""

_RMS = {
    "Sine": 1.0,
    "Square": math.sqrt(2),
    "Triangle": math.sqrt(2 / 3),
    "SawToothUp": math.sqrt(2 / 3),
    "SawToothDown": math.sqrt(2 / 3),
}
"""Root mean square of a wave over that of a sine."""

_NOT_FELT = (
    *("id", "level", "date", "description", "avatars", "avatar_id", "semantic_keywords"),
    *("reference_devices", "reference_device_id", "body_part_mask", "body_part_target"),
    *("actuator_resolution", "actuator_target", "mixing_coefficient", "block_length", "phase"),
)
"""Keys of the standard that say nothing of what one channel's vibration feels like."""

_Ticks = Annotated[float, Field(ge=0)]
_Hz = Annotated[float, Field(ge=0, le=1e6)]
_Gain = Annotated[float, Field(ge=-1000, le=1000)]


class _Keyframe(ContentSection):
    relative_position: _Ticks = 0.0
    amplitude_modulation: _Gain | None = None
    frequency_modulation: _Hz | None = None


class _Effect(ContentSection):
    effect_type: Literal["Basis", "Reference", "Composite"]
    position: _Ticks = 0.0
    id: float | None = None
    base_signal: Literal["Sine", "Square", "Triangle", "SawToothUp", "SawToothDown"] = "Sine"
    keyframes: Annotated[Entries[_Keyframe], Field(default_factory=list)]


class _Band(ContentSection):
    band_type: Literal["Transient", "VectorialWave", "Curve", "WaveletWave"]
    curve_type: Literal["Unknown", "Cubic", "Linear", "Akima", "Bezier", "Bspline"] = "Unknown"
    lower_frequency_limit: _Hz = 0.0
    upper_frequency_limit: _Hz = math.inf
    effects: Entries[_Effect]


class _Channel(ContentSection):
    gain: _Gain = 1.0
    bands: Entries[_Band]


class _Perception(ContentSection):
    perception_modality: str
    perception_unit_exponent: Annotated[float, Field(ge=-6, le=6)] = 0.0
    effect_library: Annotated[Entries[_Effect], Field(default_factory=list)]
    channels: Entries[_Channel]


class _HjifVersion(ContentSection):
    version: str
    profile: str


class _HjifFile(_HjifVersion):
    timescale: Annotated[float, Field(ge=1, le=48_000)] = 1000.0
    perceptions: Entries[_Perception]


class Hjif(ContentFormat):
    """The interchange format of MPEG haptics."""

    ending = "hjif"
    has_channels = True

    def read(self, content: bytes, source: str, channel: int) -> Pattern:
        """Return one channel of vibration."""
        document = read_json(content, source)
        start = Validation(document, _HjifVersion)
        version = start.finish()
        if not re.fullmatch("2023(-[1-9])?", version.version):
            start.add(("version",), f"must be 2023, got {version.version[:20]!r}")
        if version.profile not in ("Main", "Simple Parametric"):
            start.add(("profile",), f"must be Main or Simple Parametric, got {version.profile!r}")
        start.finish()
        validation = Validation(document, _HjifFile)
        file = validation.finish()
        found: list[tuple[KeyPath, _Perception, _Channel]] = [
            (("perceptions", p, "channels", c), perception, each)
            for p, perception in enumerate(file.perceptions)
            if perception.perception_modality in _VIBRATION
            for c, each in enumerate(perception.channels)
        ]
        if not 1 <= channel <= len(found):
            message = f"channel must be 1 to {len(found)}, got {channel}"
            raise refusal(source, message if found else "has no channel of vibration")
        path, perception, chosen = found[channel - 1]
        reading = _HjifReading(validation, perception, chosen, 1 / file.timescale)
        for index, band in enumerate(chosen.bands):
            reading.add(band, (*path, "bands", index))
        validation.finish()
        others = [each.perception_modality for each in file.perceptions]
        skipped = sorted({repr(each[:40]) for each in others if each not in _VIBRATION})
        remarks = (f"channel {channel} of {len(found)} read",) * (len(found) > 1)
        remarks += (f"perceptions of {', '.join(skipped[:5])} left out",) * bool(skipped)
        return reading.pattern(source, (*remarks, *unknown_keys(file, _NOT_FELT)))


class _HjifReading:
    """Collects what a channel's bands ask for."""

    def __init__(
        self,
        validation: Validation[_HjifFile],
        perception: _Perception,
        channel: _Channel,
        tick: float,
    ) -> None:
        """tick: its length [s]."""
        self._validation = validation
        self._library = {each.id: each for each in perception.effect_library}
        self._gain = abs(channel.gain) * 10**perception.perception_unit_exponent
        self._tick = tick
        self._count = self._moved = 0
        self._end = self._curves = 0.0
        self._segments: list[Segment] = []
        self._transients: list[Transient] = []
        self._remarks: tuple[str, ...] = ()

    def add(self, band: _Band, path: KeyPath) -> None:
        """Take a band; adds the first that is wrong with it to the problems of the file."""
        if band.band_type == "WaveletWave":
            self._validation.add(
                (*path, "band_type"),
                "bands of wavelets are not read; make WAV of the file with the MPEG reference "
                "software, `Synthesizer -f FILE.hjif -o FILE.wav`, or HJIF without wavelets of "
                "what it was made of",
            )
            return
        for index, placed in enumerate(band.effects):
            where = (*path, "effects", index)
            effect = self._library.get(placed.id) if placed.effect_type == "Reference" else placed
            if effect is None or effect.effect_type != "Basis":
                message = (
                    "must be an effect of the library"
                    if placed.effect_type == "Reference"
                    else "composite effects are not read; write the file with basis effects"
                )
                self._validation.add((*where, "id" if effect is None else "effect_type"), message)
                return
            ticks = [each.relative_position for each in effect.keyframes]
            times = [round((placed.position + each) * self._tick, 9) for each in ticks]
            self._count += len(times)
            self._end = max([self._end, *times])
            if ticks != sorted(ticks):
                self._validation.add((*where, "keyframes"), "must be in order of their positions")
                return
            if problem := too_much(self._end, self._count):
                self._validation.add(where, problem)
                return
            self._curves += (1 + times[-1] - times[0]) if times and band.band_type == "Curve" else 0
            if self._curves > _MAX_CURVES:
                self._validation.add(where, "has too many curves, or too long ones; leave some out")
                return
            if placed is not effect and placed.keyframes:
                self._remarks += ("keyframes of references left out",)
            if not times or (band.band_type != "Transient" and times[0] == times[-1]):
                self._remarks += ("effects without a duration or keyframes left out",)
                continue
            if band.band_type != "VectorialWave" and effect.base_signal != "Sine":
                self._remarks += (f"base_signal of {band.band_type} left out",)
            self._play(band, effect, times)

    def _play(self, band: _Band, effect: _Effect, times: list[float]) -> None:
        if band.band_type == "Transient":
            hertz = [each.frequency_modulation for each in effect.keyframes]
            given = np.array([_TRANSIENT_HZ if each is None else each for each in hertz])
            self._transients += [
                Transient(time, min(abs(each.amplitude_modulation or 0.0) * self._gain, 1.0), sharp)
                for time, each, sharp in zip(
                    times, effect.keyframes, self._sharpness(given), strict=True
                )
            ]
        elif band.band_type == "VectorialWave":
            self._add_wave(band, effect, times)
        else:
            self._add_curve(band, effect, times)

    def _add_wave(self, band: _Band, effect: _Effect, times: list[float]) -> None:
        factor = self._gain * _RMS[effect.base_signal]
        knots = np.unique(times)
        amplitude = abs(_course(times, effect, "amplitude_modulation", knots, 1.0)) * factor
        hertz = _course(times, effect, "frequency_modulation", knots, 0.0)
        hertz = hertz.clip(band.lower_frequency_limit, band.upper_frequency_limit)
        sharpness = self._sharpness(hertz)
        self._segments += zip(
            knots[:-1].tolist(), knots[1:].tolist(), *amplitude.tolist(), *sharpness, strict=True
        )

    def _add_curve(self, band: _Band, effect: _Effect, times: list[float]) -> None:
        """Add the vibration of a waveform between its keyframes, at which it is level."""
        from scipy.interpolate import CubicHermiteSpline  # slow to import

        knots, first = np.unique(times, return_index=True)
        given = np.array([each.amplitude_modulation or 0.0 for each in effect.keyframes])[first]
        at = np.arange(knots[0], knots[-1], 1 / _RATE)
        if band.curve_type not in ("Unknown", "Cubic", "Linear"):
            self._remarks += (f"curve: {band.curve_type} drawn as Cubic",)
        if any(each.frequency_modulation is not None for each in effect.keyframes):
            self._remarks += ("curve: frequencies of keyframes left out",)
        wave = (
            np.interp(at, knots, given)
            if band.curve_type == "Linear"
            else CubicHermiteSpline(knots, given, np.zeros(len(knots)))(at)
        )
        intensity, sharpness, remarks = course_of(wave * self._gain, _RATE)
        knots = np.unique([time for curve in (intensity, sharpness) for time, _ in curve])
        levels = between(intensity, knots).tolist()
        sharps = between(sharpness or ((0.0, 0.0),), knots).tolist()
        shifted = (knots + at[0]).tolist()
        self._segments += zip(shifted[:-1], shifted[1:], *levels, *sharps, strict=True)
        self._remarks += tuple(f"curve: {each}" for each in remarks)

    def _sharpness(self, hertz: FloatArray) -> Any:
        self._moved += int(((hertz < MIN_HZ) | (hertz > MAX_HZ)).sum())
        return sharpness_of(hertz).tolist()

    def pattern(self, source: str, remarks: tuple[str, ...]) -> Pattern:
        """Return what the bands ask for together."""
        intensity, sharpness = mixed(source, self._segments)
        if self._moved:
            what = counted(self._moved, "frequency", plural="frequencies")
            remarks += (
                f"{what} outside {MIN_HZ:g} to {MAX_HZ:g} Hz moved to the nearest of these",
            )
        transients = tuple(sorted(self._transients, key=lambda each: each.time))
        return Pattern(
            self._end, intensity, sharpness, transients, (*remarks, *dict.fromkeys(self._remarks))
        )


def _course(
    times: list[float], effect: _Effect, name: str, knots: FloatArray, default: float
) -> FloatArray:
    """Return a modulation (2, n) at both ends of each stretch between knots."""
    values: list[Any] = [getattr(each, name) for each in effect.keyframes]
    curve = [(t, v) for t, v in zip(times, values, strict=True) if v is not None]
    return between(tuple(curve) or ((0.0, default),), knots)

"""HJIF files: the interchange format of ISO/IEC 23090-31 (MPEG haptics), 2023.

Reads the bands Transient, VectorialWave and Curve of profile Main, for one vibration channel;
wavelet bands are rejected. Intensity is the amplitude, as the reference encoder writes it for AHAP;
waveforms other than sines become sines of equal RMS.
"""

import math
import re
from collections.abc import Sequence
from operator import attrgetter
from typing import Annotated, Literal, NamedTuple

import numpy as np
from pydantic import Field

from controller.content.mixing import Segment, mixed, stretches_between
from controller.content.pattern import MAX_HZ, MIN_HZ, Pattern, Transient, sharpness_of
from controller.content.reading import (
    ContentFormat,
    ContentSection,
    Entries,
    read_json,
    refusal,
    too_much,
    unknown_keys,
)
from controller.content.wav_format import pattern_of_signal
from model.arrays import FloatArray
from model.config.document import KeyPath
from model.config.fields import Validation
from model.quantities import counted

_VIBRATION = ("Other", "Acceleration", "Vibration", "Vibrotactile", "Vibrotactile Texture")
"""Modalities of perceptions that are read."""

_SAMPLE_RATE = 2000  # Hz, of curves
_MAX_CURVES = 600.0  # s; total of all curves of a file, each a second longer
_TRANSIENT_HZ = 90.0
"""Frequency [Hz] of a transient without one, from the reference encoder."""

_RMS = {
    "Sine": 1.0,
    "Square": math.sqrt(2),
    "Triangle": math.sqrt(2 / 3),
    "SawToothUp": math.sqrt(2 / 3),
    "SawToothDown": math.sqrt(2 / 3),
}
"""Root mean square of a waveform, relative to a sine."""

_NOT_FELT = {
    "actuator_resolution",
    "actuator_target",
    "avatar_id",
    "avatars",
    "block_length",
    "body_part_mask",
    "body_part_target",
    "date",
    "description",
    "id",
    "level",
    "mixing_coefficient",
    "phase",
    "reference_device_id",
    "reference_devices",
    "semantic_keywords",
}
"""Keys of the standard that do not affect the vibration."""

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


class _ChannelAt(NamedTuple):
    """A channel of vibration, its place in the file and its perception."""

    path: KeyPath
    perception: _Perception
    channel: _Channel


class Hjif(ContentFormat):
    """The interchange format of MPEG haptics."""

    ending = "hjif"
    has_channels = True

    def read(self, content: bytes, source: str, channel: int) -> Pattern:
        """Return one channel of vibration."""
        document = read_json(content, source)
        version_check = Validation(document, _HjifVersion)
        version = version_check.finish()
        if not re.fullmatch("2023(-[1-9])?", version.version):
            version_check.add(("version",), f"must be 2023, got {version.version[:20]!r}")
        if version.profile not in ("Main", "Simple Parametric"):
            message = f"must be Main or Simple Parametric, got {version.profile!r}"
            version_check.add(("profile",), message)
        version_check.finish()
        validation = Validation(document, _HjifFile)
        file = validation.finish()
        channels = _vibration_channels(file)
        if not channels:
            raise refusal(source, "has no channel of vibration")
        if not 1 <= channel <= len(channels):
            raise refusal(source, f"channel must be 1 to {len(channels)}, got {channel}")
        selected = channels[channel - 1]
        reading = _HjifReading(validation, selected, 1 / file.timescale)
        for index, band in enumerate(selected.channel.bands):
            reading.add(band, (*selected.path, "bands", index))
        validation.finish()
        remarks = []
        if len(channels) > 1:
            remarks.append(f"channel {channel} of {len(channels)} read")
        modalities = {perception.perception_modality for perception in file.perceptions}
        skipped = sorted({repr(name[:40]) for name in modalities.difference(_VIBRATION)})
        if skipped:
            remarks.append(f"perceptions of {', '.join(skipped[:5])} left out")
        return reading.pattern(source, (*remarks, *unknown_keys(file, _NOT_FELT)))


def _vibration_channels(file: _HjifFile) -> list[_ChannelAt]:
    """Return all channels of vibration, in the order of the file."""
    channels = []
    for perception_index, perception in enumerate(file.perceptions):
        if perception.perception_modality in _VIBRATION:
            for index, channel in enumerate(perception.channels):
                path = ("perceptions", perception_index, "channels", index)
                channels.append(_ChannelAt(path, perception, channel))
    return channels


class _InvalidEffect(Exception):
    """An effect that cannot be read; key: of the effect, "" for the effect as a whole."""

    def __init__(self, message: str, key: str = "") -> None:
        super().__init__(message)
        self.key = key


class _HjifReading:
    """Collects the vibrations of a channel's bands."""

    def __init__(
        self, validation: Validation[_HjifFile], selected: _ChannelAt, tick: float
    ) -> None:
        """tick: its length [s]."""
        perception = selected.perception
        self._validation = validation
        self._library = {effect.id: effect for effect in perception.effect_library}
        self._gain = abs(selected.channel.gain) * 10**perception.perception_unit_exponent
        self._tick = tick
        self._count = 0  # keyframes so far
        self._end = 0.0  # s, of the keyframes so far
        self._curve_duration = 0.0  # s, of the curves so far; each counts a second more
        self._moved_count = 0  # frequencies outside 65 to 300 Hz
        self._segments: list[Segment] = []
        self._transients: list[Transient] = []
        self._remarks: dict[str, None] = {}  # in order, each once

    def add(self, band: _Band, path: KeyPath) -> None:
        """Add a band, or report its first problem."""
        if band.band_type == "WaveletWave":
            self._validation.add(
                (*path, "band_type"),
                "wavelet bands are not supported; convert the file to WAV with the MPEG reference "
                "software, `Synthesizer -f FILE.hjif -o FILE.wav`, or export its source as HJIF "
                "without wavelets",
            )
            return
        for index, effect in enumerate(band.effects):
            try:
                self._add_effect(band, effect)
            except _InvalidEffect as error:
                effect_path: KeyPath = (*path, "effects", index)
                key_path = (*effect_path, error.key) if error.key else effect_path
                self._validation.add(key_path, str(error))
                return

    def _add_effect(self, band: _Band, placed: _Effect) -> None:
        """Add an effect of a band; raises _InvalidEffect."""
        effect = self._basis_effect(placed)
        positions = [keyframe.relative_position for keyframe in effect.keyframes]
        times = [round((placed.position + position) * self._tick, 9) for position in positions]
        self._count += len(times)
        self._end = max([self._end, *times])
        if positions != sorted(positions):
            raise _InvalidEffect("must be in order of their positions", "keyframes")
        problem = too_much(self._end, self._count)
        if problem:
            raise _InvalidEffect(problem)
        if times and band.band_type == "Curve":
            self._curve_duration += 1 + times[-1] - times[0]
        if self._curve_duration > _MAX_CURVES:
            raise _InvalidEffect("has too many curves, or too long ones; leave some out")
        if placed is not effect and placed.keyframes:
            self._remark("keyframes of references left out")
        has_duration = times and (band.band_type == "Transient" or times[0] != times[-1])
        if not has_duration:
            self._remark("effects without a duration or keyframes left out")
            return
        if band.band_type != "VectorialWave" and effect.base_signal != "Sine":
            self._remark(f"base_signal of {band.band_type} left out")
        if band.band_type == "Transient":
            self._add_transients(effect, times)
        elif band.band_type == "VectorialWave":
            self._add_wave(band, effect, times)
        else:
            self._add_curve(band, effect, times)

    def _basis_effect(self, placed: _Effect) -> _Effect:
        """Return an effect, or the effect of the library that it refers to."""
        if placed.effect_type == "Basis":
            return placed
        if placed.effect_type == "Composite":
            message = "composite effects are not read; write the file with basis effects"
            raise _InvalidEffect(message, "effect_type")
        effect = self._library.get(placed.id)
        if effect is None:
            raise _InvalidEffect("must be an effect of the library", "id")
        if effect.effect_type != "Basis":
            raise _InvalidEffect("must be an effect of the library", "effect_type")
        return effect

    def _remark(self, remark: str) -> None:
        self._remarks[remark] = None

    def _add_transients(self, effect: _Effect, times: list[float]) -> None:
        hertz = np.full(len(times), _TRANSIENT_HZ)
        for index, keyframe in enumerate(effect.keyframes):
            if keyframe.frequency_modulation is not None:
                hertz[index] = keyframe.frequency_modulation
        sharpnesses = self._sharpness(hertz).tolist()
        for time, amplitude, sharpness in zip(times, _amplitudes(effect), sharpnesses, strict=True):
            intensity = min(abs(amplitude) * self._gain, 1.0)
            self._transients.append(Transient(time, intensity, sharpness))

    def _add_wave(self, band: _Band, effect: _Effect, times: list[float]) -> None:
        factor = self._gain * _RMS[effect.base_signal]
        knots = np.unique(times)
        amplitude = _modulation(times, effect, "amplitude_modulation", knots, 1.0)
        hertz = _modulation(times, effect, "frequency_modulation", knots, 0.0)
        hertz = hertz.clip(band.lower_frequency_limit, band.upper_frequency_limit)
        self._add_segments(knots, abs(amplitude) * factor, self._sharpness(hertz))

    def _add_curve(self, band: _Band, effect: _Effect, times: list[float]) -> None:
        """Add the vibration of a waveform between its keyframes, with zero slope at each."""
        knots, first_keyframes = np.unique(times, return_index=True)
        amplitudes = np.array(_amplitudes(effect))[first_keyframes]
        if band.curve_type not in ("Unknown", "Cubic", "Linear"):
            self._remark(f"curve: {band.curve_type} drawn as Cubic")
        if any(keyframe.frequency_modulation is not None for keyframe in effect.keyframes):
            self._remark("curve: frequencies of keyframes left out")
        start = knots[0]
        sample_times = np.arange(start, knots[-1], 1 / _SAMPLE_RATE)
        if band.curve_type == "Linear":
            waveform = np.interp(sample_times, knots, amplitudes)
        else:
            waveform = _cubic(sample_times, knots, amplitudes)
        course = pattern_of_signal(waveform * self._gain, _SAMPLE_RATE)
        course_knots = np.unique([time for time, _ in (*course.intensity, *course.sharpness)])
        levels = stretches_between(course.intensity, course_knots)
        sharpness = stretches_between(course.sharpness or ((0.0, 0.0),), course_knots)
        self._add_segments(course_knots + start, levels, sharpness)
        for remark in course.remarks:
            self._remark(f"curve: {remark}")

    def _add_segments(self, knots: FloatArray, levels: FloatArray, sharpness: FloatArray) -> None:
        """Add a segment for each interval between knots; levels, sharpness: at both its ends."""
        columns = [knots[:-1], knots[1:], *levels, *sharpness]
        self._segments += zip(*(column.tolist() for column in columns), strict=True)

    def _sharpness(self, hertz: FloatArray) -> FloatArray:
        """Return the sharpness of frequencies, and count frequencies outside 65 to 300 Hz."""
        self._moved_count += int(((hertz < MIN_HZ) | (hertz > MAX_HZ)).sum())
        return sharpness_of(hertz)

    def pattern(self, source: str, remarks: tuple[str, ...]) -> Pattern:
        """Return the pattern of all bands; remarks: listed before the remarks of the reading."""
        intensity, sharpness = mixed(source, self._segments)
        if self._moved_count:
            frequencies = counted(self._moved_count, "frequency", plural="frequencies")
            limits = f"{MIN_HZ:g} to {MAX_HZ:g} Hz"
            remarks += (f"{frequencies} outside {limits} moved to the nearest limit",)
        transients = tuple(sorted(self._transients, key=attrgetter("time")))
        return Pattern(self._end, intensity, sharpness, transients, (*remarks, *self._remarks))


def _amplitudes(effect: _Effect) -> list[float]:
    """Return the amplitude at each keyframe; 0 without one."""
    return [keyframe.amplitude_modulation or 0.0 for keyframe in effect.keyframes]


def _cubic(sample_times: FloatArray, knots: FloatArray, amplitudes: FloatArray) -> FloatArray:
    """Interpolate between amplitudes at knots by cubic polynomials with zero slope at each knot."""
    from scipy.interpolate import CubicHermiteSpline  # slow to import

    spline = CubicHermiteSpline(knots, amplitudes, np.zeros(len(knots)))
    return np.asarray(spline(sample_times))


def _modulation(
    times: Sequence[float], effect: _Effect, name: str, knots: FloatArray, default: float
) -> FloatArray:
    """Return a modulation (2, n) at both ends of each interval between knots."""
    curve = []
    for time, keyframe in zip(times, effect.keyframes, strict=True):
        value = getattr(keyframe, name)
        if value is not None:
            curve.append((time, value))
    return stretches_between(curve or ((0.0, default),), knots)

"""Content formats by file extension, and the built-in contents.

AHAP: Apple's haptic and audio patterns, version 1. Missing values have their defaults, values out
of range are clamped, unknown keys are ignored, and trailing commas are allowed; the remarks list
everything clamped, ignored or left out. Sources: Apple, "Representing haptic patterns in AHAP
files", and the header CHHapticParameter.h. Apple publishes neither the defaults of HapticIntensity
and HapticSharpness, here 1 (no attenuation) and 0.5, nor AttackTime, DecayTime and ReleaseTime in
seconds, here 10 ms times 100 to that power, and 0 s for 0.

.haptic: files of Haptics Studio and NiceVibrations, version 1. Intensity is the square root of an
amplitude, and the sharpness of a continuous event the square root of a frequency, as in the
format's own converter to AHAP (NiceVibrations, core/datamodel/src/ios/v1.rs); files that the
converter rejects are rejected here. Unknown keys of later minor versions are ignored.

HJIF: the interchange format of ISO/IEC 23090-31 (MPEG haptics), 2023. Reads the bands Transient,
VectorialWave and Curve of profile Main, for one vibration channel; wavelet bands are rejected.
Intensity is the amplitude, as the reference encoder writes it for AHAP; waveforms other than sines
are converted by their root mean square.

WAV is in `reading`; installed packages can add formats.
"""

import math
import re
from bisect import bisect_left, bisect_right
from collections import Counter
from collections.abc import Sequence
from operator import attrgetter, itemgetter
from pathlib import Path
from typing import Annotated, Any, Literal, TypeAlias

import numpy as np
from pydantic import Field

from controller.content.pattern import (
    MAX_HZ,
    MIN_HZ,
    Curve,
    Pattern,
    Transient,
    misfit,
    sharpness_of,
)
from controller.content.reading import (
    MAX_SIZE,
    ContentFormat,
    ContentSection,
    Entries,
    Segment,
    Wav,
    course_of,
    mixed,
    names_remark,
    read_json,
    refusal,
    stretches_between,
    too_much,
    unknown_keys,
)
from model.arrays import FloatArray
from model.config.document import KeyPath, read_bytes
from model.config.fields import Validation
from model.errors import InputError
from model.quantities import counted
from registry.plugins import PluginRegistry, WrongResultError, did_you_mean

_EVENT = {
    "HapticIntensity": (0.0, 1.0, 1.0),
    "HapticSharpness": (0.0, 1.0, 0.5),
    "AttackTime": (0.0, 1.0, 0.0),
    "DecayTime": (0.0, 1.0, 0.0),
    "ReleaseTime": (0.0, 1.0, 0.0),
    "Sustained": (0.0, 1.0, 1.0),
}
_CONTROL = {
    "HapticIntensityControl": (0.0, 1.0, 1.0),
    "HapticSharpnessControl": (-1.0, 1.0, 0.0),
    "HapticAttackTimeControl": (-1.0, 1.0, 0.0),
    "HapticDecayTimeControl": (-1.0, 1.0, 0.0),
    "HapticReleaseTimeControl": (-1.0, 1.0, 0.0),
}
"""Lowest, highest and default value of each parameter."""

_PARAMETERS = (*_EVENT, *_CONTROL)
_PHASES = ("AttackTime", "DecayTime", "ReleaseTime")
_LASTING = (*_PHASES, "Sustained")  # without effect on a transient

_AUDIO = "Audio"  # prefix of the names of audio parameters and events

_MAX_TIME = 1e6  # s; of a parameter after all events

_Control: TypeAlias = tuple[list[float], list[float]]


class _Value(ContentSection):
    ParameterID: str
    ParameterValue: float | None = None
    Time: float = 0.0


class _Event(ContentSection):
    EventType: Literal["HapticTransient", "HapticContinuous", "AudioContinuous", "AudioCustom"]
    Time: float = 0.0
    EventDuration: float = 0.0
    EventWaveformPath: str = ""
    EventParameters: Annotated[Entries[_Value], Field(default_factory=list)]


class _ControlPoint(ContentSection):
    Time: float = 0.0
    ParameterValue: float | None = None


class _ParameterCurve(ContentSection):
    ParameterID: str
    Time: float = 0.0
    ParameterCurveControlPoints: Annotated[Entries[_ControlPoint], Field(default_factory=list)]


class _Entry(ContentSection):
    Event: _Event | None = None
    Parameter: _Value | None = None
    ParameterCurve: _ParameterCurve | None = None


class _Ahap(ContentSection):
    Version: Annotated[float, Field(ge=0)] = 1.0
    Metadata: object = None
    Pattern: Entries[_Entry]


class Ahap(ContentFormat):
    """Apple's haptic and audio patterns."""

    ending = "ahap"

    def read(self, content: bytes, source: str, channel: int) -> Pattern:
        """Return the haptic events, with dynamic parameters and curves applied."""
        document = read_json(content, source, has_trailing_commas=True)
        validation = Validation(document, _Ahap)
        file = validation.finish()
        if file.Version >= 2:
            validation.add(("Version",), f"must be below 2, got {file.Version:g}")
        reading = _AhapReading()
        for index, entry in enumerate(file.Pattern):
            reading.add(entry)
            if problem := too_much(reading.end, reading.count):
                validation.add(("Pattern", index), problem)
                break
        validation.finish()
        intensity, sharpness, transients = reading.result(source)
        ends = [each[-1][0] for each in (intensity,) if each] + [each.time for each in transients]
        return Pattern(
            max(ends, default=0.0),
            intensity,
            sharpness,
            transients,
            (*reading.remarks(), *unknown_keys(file)),
        )


class _AhapReading:
    """Collects the events and parameters of a file, and counts clamped or skipped ones."""

    def __init__(self) -> None:
        self.end = 0.0  # s, of the events so far
        self.count = 0  # points so far
        self._events: list[tuple[_Event, dict[str, float]]] = []
        self._controls: dict[str, list[Curve]] = {name: [] for name in _CONTROL}
        self._skipped: Counter[tuple[str, str]] = Counter()
        self._audio_parameters: Counter[str] = Counter()
        self._unknown_parameters: Counter[str] = Counter()
        self._clamped: dict[str, list[float]] = {}

    def add(self, entry: _Entry) -> None:
        """Add an entry of a pattern."""
        if entry.Event is not None:
            self._add_event(entry.Event)
        if entry.Parameter is not None:
            time = self._in_range("Time", entry.Parameter.Time, 0.0, _MAX_TIME)
            self._add_control(entry.Parameter.ParameterID, time, ((0.0, entry.Parameter),))
        if entry.ParameterCurve is not None:
            curve = entry.ParameterCurve
            time = self._in_range("Time", curve.Time, 0.0, _MAX_TIME)
            points = ((each.Time, each) for each in curve.ParameterCurveControlPoints)
            self._add_control(curve.ParameterID, time, tuple(points))

    def _add_event(self, event: _Event) -> None:
        self.count += 1
        if event.EventType.startswith(_AUDIO):
            self._skipped["audio event", "audio events"] += 1
            return
        values = {name: default for name, (_, _, default) in _EVENT.items()}
        for each in event.EventParameters:
            if each.ParameterID not in _EVENT:
                self._leave_out(each.ParameterID)
            elif each.ParameterValue is not None:
                low, high, _ = _EVENT[each.ParameterID]
                value = self._in_range(each.ParameterID, each.ParameterValue, low, high)
                values[each.ParameterID] = value
        values["Time"] = self._in_range("Time", event.Time, 0.0, _MAX_TIME)
        duration = self._in_range("EventDuration", event.EventDuration, 0.0, _MAX_TIME)
        lasts = event.EventType == "HapticContinuous"
        if not lasts and any(values[name] != _EVENT[name][2] for name in _LASTING):
            self._skipped["envelope of a transient", "envelopes of transients"] += 1
        if not lasts and duration:
            self._skipped["duration of a transient", "durations of transients"] += 1
        values["End"] = values["Time"] + duration * lasts
        self._events.append((event, values))
        self.end = max(self.end, values["End"])

    def _add_control(
        self, name: str, start: float, points: tuple[tuple[float, _Value | _ControlPoint], ...]
    ) -> None:
        self.count += len(points)
        if name not in _CONTROL:
            self._leave_out(name)
            return
        low, high, default = _CONTROL[name]
        curve = [
            (
                start + self._in_range("Time", time, 0.0, _MAX_TIME),
                default
                if each.ParameterValue is None
                else self._in_range(name, each.ParameterValue, low, high),
            )
            for time, each in points
        ]
        if curve:
            self._controls[name].append(tuple(sorted(curve, key=itemgetter(0))))
        else:
            self._skipped["curve without points", "curves without points"] += 1

    def _leave_out(self, parameter: str) -> None:
        """Count a parameter that has no effect on vibration."""
        is_audio = parameter.startswith(_AUDIO)
        names = self._audio_parameters if is_audio else self._unknown_parameters
        names[parameter] += 1

    def _in_range(self, name: str, value: float, low: float, high: float) -> float:
        if low <= value <= high:
            return value
        self._clamped.setdefault(name, []).append(value)
        return min(max(value, low), high)

    def result(self, source: str) -> tuple[Curve, Curve, tuple[Transient, ...]]:
        """Return intensity and sharpness of the continuous part, and the transients in order."""
        controls = {name: _joined(self._controls[name], _CONTROL[name][2]) for name in _CONTROL}
        segments: list[Segment] = []
        transients = []
        for event, values in self._events:
            if event.EventType == "HapticTransient":
                time = values["Time"]
                intensity = values["HapticIntensity"] * _at(
                    controls["HapticIntensityControl"], time
                )
                sharp = values["HapticSharpness"] + _at(controls["HapticSharpnessControl"], time)
                transients.append(Transient(time, intensity, min(max(sharp, 0.0), 1.0)))
            else:
                segments += _segments(values, controls)
        intensity_curve, sharpness = mixed(
            source,
            segments,
            factor=tuple(zip(*controls["HapticIntensityControl"], strict=True)),
            addend=tuple(zip(*controls["HapticSharpnessControl"], strict=True)),
        )
        transients.sort(key=attrgetter("time"))
        return intensity_curve, sharpness, tuple(transients)

    def remarks(self) -> tuple[str, ...]:
        """Return a remark for each kind of entry that was left out or clamped."""
        parameters = (
            *names_remark("unknown parameter", self._unknown_parameters, known=_PARAMETERS),
            *names_remark("audio parameter", self._audio_parameters),
        )
        lasts = any(event.EventType == "HapticContinuous" for event, _ in self._events)
        for name in [] if lasts else [f"Haptic{each}Control" for each in _PHASES]:
            self._skipped[name, f"{name}s"] += len(self._controls[name])
        skipped = [
            f"{counted(n, what, plural=plural)} left out"
            for (what, plural), n in self._skipped.items()
            if n
        ]
        clamped = [
            f"{name}: {counted(len(values), 'value')} out of range clamped, got {_span(values)}"
            for name, values in self._clamped.items()
        ]
        return (*parameters, *skipped, *clamped)


def _span(values: Sequence[float]) -> str:
    """Format the range of values, or a single value."""
    least, greatest = min(values), max(values)
    return f"{least:g}" if least == greatest else f"{least:g} to {greatest:g}"


def _segments(values: dict[str, float], controls: dict[str, _Control]) -> list[Segment]:
    """Return attack and plateau or decay, and release, of a continuous event."""
    start, end = values["Time"], values["End"]
    attack, decay, release = (
        _seconds(values[f"{phase}Time"] + _at(controls[f"Haptic{phase}TimeControl"], start))
        for phase in ("Attack", "Decay", "Release")
    )
    level, sharpness = values["HapticIntensity"], values["HapticSharpness"]
    full = min(start + attack, end)
    top = level * (full - start) / attack if attack else level
    segments = [(start, full, 0.0, top, sharpness, sharpness)]
    if values["Sustained"] >= 0.5:
        segments.append((full, end, top, top, sharpness, sharpness))
        segments.append((end, end + release, top, 0.0, sharpness, sharpness))
    else:
        out = min(full + decay, end) if decay else full
        left = top * (1 - (out - full) / decay) if decay else 0.0
        segments.append((full, out, top, left, sharpness, sharpness))
    return segments


def _seconds(value: float) -> float:
    """Convert an attack, decay or release value to a time [s]."""
    return 0.01 * 100.0 ** min(value, 1.0) if value > 0 else 0.0


def _joined(pieces: list[Curve], default: float) -> _Control:
    """Join pieces to one curve; each piece lasts until the next one starts."""
    times, values = [0.0], [default]
    for piece in sorted(pieces, key=lambda each: each[0][0]):
        start = piece[0][0]
        kept = bisect_left(times, start)
        before = values[max(kept - 1, 0)]
        if 0 < kept < len(times):
            share = (start - times[kept - 1]) / (times[kept] - times[kept - 1])
            before += share * (values[kept] - before)
        times[kept:] = [start, *(time for time, _ in piece)]
        values[kept:] = [before, *(value for _, value in piece)]
    return times, values


def _at(control: _Control, time: float) -> float:
    """Return a control's value at a time, after a step there."""
    times, values = control
    after = bisect_right(times, time)
    if after in (0, len(times)):
        return values[min(after, len(times) - 1)]
    share = (time - times[after - 1]) / (times[after] - times[after - 1])
    return values[after - 1] + share * (values[after] - values[after - 1])


_Share = Annotated[float, Field(ge=0, le=1)]
_Time = Annotated[float, Field(ge=0)]


class _Version(ContentSection):
    major: float
    minor: float = 0
    patch: float = 0


class _Emphasis(ContentSection):
    amplitude: _Share
    frequency: _Share


class _Amplitude(ContentSection):
    time: _Time
    amplitude: _Share
    emphasis: _Emphasis | None = None


class _Frequency(ContentSection):
    time: _Time
    frequency: _Share


class _Envelopes(ContentSection):
    amplitude: Annotated[Entries[_Amplitude], Field(min_length=1)]
    frequency: Entries[_Frequency] | None = None


class _Continuous(ContentSection):
    envelopes: _Envelopes


class _Signals(ContentSection):
    continuous: _Continuous


class _HapticVersion(ContentSection):
    version: _Version


class _HapticFile(_HapticVersion):
    signals: _Signals
    metadata: object = None


class Haptic(ContentFormat):
    """Envelopes of amplitude and frequency, and emphases."""

    ending = "haptic"

    def read(self, content: bytes, source: str, channel: int) -> Pattern:
        """Return the envelopes as curves, and the emphases as transients."""
        document = read_json(content, source)
        start = Validation(document, _HapticVersion)
        version = start.finish().version
        if version.major != 1:
            start.add(
                ("version", "major"),
                f"must be 1, got {version.major:g}; export the content with a program that writes "
                "version 1",
            )
        start.finish()
        validation = Validation(document, _HapticFile)
        file = validation.finish()
        envelopes = file.signals.continuous.envelopes
        frequencies = envelopes.frequency or []
        path = ("signals", "continuous", "envelopes")
        ends = dict[float, KeyPath]()
        for name, points in (("frequency", frequencies), ("amplitude", envelopes.amplitude)):
            _check_order(validation, (*path, name), [each.time for each in points])
            ends |= {each.time: (*path, name, len(points) - 1) for each in points[-1:]}
        if problem := too_much(max(ends), 0):
            validation.add(ends[max(ends)], problem)
        for index, each in enumerate(envelopes.amplitude):
            if each.emphasis is not None and each.emphasis.amplitude < each.amplitude:
                validation.add(
                    (*path, "amplitude", index, "emphasis", "amplitude"),
                    f"must be at least the amplitude there, {each.amplitude:g}, "
                    f"got {each.emphasis.amplitude:g}",
                )
                break
        validation.finish()
        return Pattern(
            envelopes.amplitude[-1].time,
            tuple((each.time, math.sqrt(each.amplitude)) for each in envelopes.amplitude),
            tuple((each.time, math.sqrt(each.frequency)) for each in frequencies),
            tuple(
                Transient(each.time, math.sqrt(each.emphasis.amplitude), each.emphasis.frequency)
                for each in envelopes.amplitude
                if each.emphasis is not None
            ),
            unknown_keys(file),
        )


def _check_order(
    validation: Validation[_HapticFile],
    path: KeyPath,
    times: list[float],
) -> None:
    """Check that times are in ascending order."""
    before = 0.0
    for index, time in enumerate(times):
        if time < before:
            message = f"must be at least {before:g}, as at the previous point, got {time:g}"
            validation.add((*path, index, "time"), message)
            return
        before = time


_VIBRATION = ("Other", "Acceleration", "Vibration", "Vibrotactile", "Vibrotactile Texture")
_RATE = 2000  # Hz, at which a curve is sampled
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
"""Keys of the standard that do not affect the vibration of one channel."""

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
    """Collects the vibrations of a channel's bands."""

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
        """Add a band, or report its first problem."""
        if band.band_type == "WaveletWave":
            self._validation.add(
                (*path, "band_type"),
                "wavelet bands are not supported; convert the file to WAV with the MPEG reference "
                "software, `Synthesizer -f FILE.hjif -o FILE.wav`, or export its source as HJIF "
                "without wavelets",
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
        """Add the vibration of a waveform between its keyframes, with zero slope at each."""
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
        course = course_of(wave * self._gain, _RATE)
        knots = np.unique([time for time, _ in (*course.intensity, *course.sharpness)])
        levels = stretches_between(course.intensity, knots).tolist()
        sharps = stretches_between(course.sharpness or ((0.0, 0.0),), knots).tolist()
        shifted = (knots + at[0]).tolist()
        self._segments += zip(shifted[:-1], shifted[1:], *levels, *sharps, strict=True)
        self._remarks += tuple(f"curve: {remark}" for remark in course.remarks)

    def _sharpness(self, hertz: FloatArray) -> Any:
        self._moved += int(((hertz < MIN_HZ) | (hertz > MAX_HZ)).sum())
        return sharpness_of(hertz).tolist()

    def pattern(self, source: str, remarks: tuple[str, ...]) -> Pattern:
        """Return the pattern of all bands."""
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
    """Return a modulation (2, n) at both ends of each interval between knots."""
    values: list[Any] = [getattr(each, name) for each in effect.keyframes]
    curve = [(t, v) for t, v in zip(times, values, strict=True) if v is not None]
    return stretches_between(tuple(curve) or ((0.0, default),), knots)


BUILT_IN_FORMATS: tuple[type[ContentFormat], ...] = (Ahap, Haptic, Hjif, Wav)
"""Built-in formats."""

_FORMATS: PluginRegistry[type[ContentFormat]] = PluginRegistry(
    "format of content",
    "era_haptics.content_formats",
    ContentFormat,
    error=InputError,
    own={each.ending: each for each in BUILT_IN_FORMATS},
    called=attrgetter("ending"),
)

_REFUSED = {
    "vij": "is version 0 of the .haptic format; export the content as .haptic, version 1",
    "hmpg": "is the binary form of HJIF; convert it to HJIF with the MPEG reference software, "
    "`Decoder -f FILE.hmpg -o FILE.hjif`, or WAV, `Synthesizer -b -f FILE.hmpg -o FILE.wav`",
}

_NAMED = Path(__file__).with_name("named")


def content_formats() -> tuple[str, ...]:
    """Return the extensions of all formats, built-in formats first; loads no plug-in."""
    return _FORMATS.names()


def content_format(ending: str, *, within: str = "") -> type[ContentFormat]:
    """Return the format of an extension; raises InputError if unknown or if its plug-in fails.

    within: the file's name, for the error.
    """
    return _FORMATS.find(ending, within=within)


def read_content(path: Path, channel: int | None = None) -> Pattern:
    """Read a content file; raises InputError, with line and key, if it cannot be read.

    channel: counted from 1, for formats with several channels; None for the first.
    """
    source, name = str(path), path.name.lower()
    known = [each for each in content_formats() if name.endswith(f".{each}")]
    ending = max(known, key=len, default=path.suffix[1:].lower())
    if ending in _REFUSED:
        raise refusal(source, _REFUSED[ending])
    reader = content_format(ending, within=source)()
    if channel is not None and not reader.has_channels:
        raise refusal(source, f"channel must be left out: .{ending} has no channels")
    if channel is not None and channel < 1:
        raise refusal(source, f"channel must be at least 1, got {channel}")
    given = read_bytes(
        path, MAX_SIZE, is_for="shorten the content", give="the content as a file of its own"
    )
    pattern = reader.read(given, source, channel or 1)
    if not isinstance(pattern, Pattern):
        raise WrongResultError(reader, pattern, Pattern)
    count = len(pattern.intensity) + len(pattern.transients)
    if problem := too_much(pattern.duration, count) or misfit(pattern):
        raise refusal(source, problem)
    return pattern


def named_contents() -> tuple[str, ...]:
    """Return the names of the built-in contents."""
    return tuple(sorted(each.stem for each in _NAMED.iterdir()))


def named_content(name: str) -> Path:
    """Return the file of a built-in content; raises InputError for an unknown name."""
    for each in _NAMED.iterdir():
        if each.stem == name:
            return each
    known = named_contents()
    raise InputError(
        f"unknown content {name[:40]!a}; {did_you_mean(name, known)}known are {', '.join(known)}; "
        "the name of a file needs its ending"
    )

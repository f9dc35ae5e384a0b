"""AHAP files: Apple's haptic and audio patterns, version 1.

Missing values have their defaults, values out of range are clamped, unknown keys are ignored, and
trailing commas are allowed; the remarks list everything clamped, ignored or left out. Sources:
Apple, "Representing haptic patterns in AHAP files", and the header CHHapticParameter.h. Apple
publishes neither the defaults of HapticIntensity and HapticSharpness, here 1 (no attenuation) and
0.5, nor AttackTime, DecayTime and ReleaseTime in seconds, here 10 ms times 100 to that power, and
0 s for 0.
"""

from bisect import bisect_left, bisect_right
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from operator import attrgetter, itemgetter
from typing import Annotated, Literal, NamedTuple, TypeAlias

from pydantic import Field

from controller.content.mixing import Segment, mixed
from controller.content.pattern import Curve, Pattern, Transient
from controller.content.reading import (
    ContentFormat,
    ContentSection,
    Entries,
    names_remark,
    read_json,
    too_much,
    unknown_keys,
)
from model.config.fields import Validation
from model.quantities import counted


class _Range(NamedTuple):
    """Lowest, highest and default value of a parameter."""

    low: float
    high: float
    default: float


_EVENT = {
    "HapticIntensity": _Range(0.0, 1.0, 1.0),
    "HapticSharpness": _Range(0.0, 1.0, 0.5),
    "AttackTime": _Range(0.0, 1.0, 0.0),
    "DecayTime": _Range(0.0, 1.0, 0.0),
    "ReleaseTime": _Range(0.0, 1.0, 0.0),
    "Sustained": _Range(0.0, 1.0, 1.0),
}
"""Parameters of an event."""

_CONTROL = {
    "HapticIntensityControl": _Range(0.0, 1.0, 1.0),
    "HapticSharpnessControl": _Range(-1.0, 1.0, 0.0),
    "HapticAttackTimeControl": _Range(-1.0, 1.0, 0.0),
    "HapticDecayTimeControl": _Range(-1.0, 1.0, 0.0),
    "HapticReleaseTimeControl": _Range(-1.0, 1.0, 0.0),
}
"""Dynamic parameters, which change over time."""

_ENVELOPE = ("AttackTime", "DecayTime", "ReleaseTime", "Sustained")
"""Parameters without effect on a transient."""

_ENVELOPE_CONTROLS = (
    "HapticAttackTimeControl",
    "HapticDecayTimeControl",
    "HapticReleaseTimeControl",
)
"""Dynamic parameters without effect on a transient."""

_AUDIO = "Audio"  # prefix of the names of audio parameters and events

_MAX_TIME = 1e6  # s; of a parameter after all events


class _ParameterEntry(ContentSection):
    ParameterID: str
    ParameterValue: float | None = None
    Time: float = 0.0


class _EventEntry(ContentSection):
    EventType: Literal["HapticTransient", "HapticContinuous", "AudioContinuous", "AudioCustom"]
    Time: float = 0.0
    EventDuration: float = 0.0
    EventWaveformPath: str = ""
    EventParameters: Annotated[Entries[_ParameterEntry], Field(default_factory=list)]


class _ControlPoint(ContentSection):
    Time: float = 0.0
    ParameterValue: float | None = None


class _ParameterCurve(ContentSection):
    ParameterID: str
    Time: float = 0.0
    ParameterCurveControlPoints: Annotated[Entries[_ControlPoint], Field(default_factory=list)]


class _PatternEntry(ContentSection):
    Event: _EventEntry | None = None
    Parameter: _ParameterEntry | None = None
    ParameterCurve: _ParameterCurve | None = None


class _AhapFile(ContentSection):
    Version: Annotated[float, Field(ge=0)] = 1.0
    Metadata: object = None
    Pattern: Entries[_PatternEntry]


class Ahap(ContentFormat):
    """Apple's haptic and audio patterns."""

    ending = "ahap"

    def read(self, content: bytes, source: str, channel: int) -> Pattern:
        """Return the haptic events, with dynamic parameters and curves applied."""
        document = read_json(content, source, has_trailing_commas=True)
        validation = Validation(document, _AhapFile)
        file = validation.finish()
        if file.Version >= 2:
            validation.add(("Version",), f"must be below 2, got {file.Version:g}")
        reading = _AhapReading()
        for index, entry in enumerate(file.Pattern):
            reading.add(entry)
            problem = too_much(reading.end, reading.count)
            if problem:
                validation.add(("Pattern", index), problem)
                break
        validation.finish()
        return reading.pattern(source, unknown_keys(file))


@dataclass(frozen=True)
class _HapticEvent:
    """A haptic event with all of its parameters."""

    is_transient: bool
    start: float
    end: float
    parameters: Mapping[str, float]


@dataclass
class _Control:
    """A dynamic parameter over time: straight lines between points, steps at equal times."""

    times: list[float]
    values: list[float]

    def value_at(self, time: float) -> float:
        """Return the value at a time, after a step there."""
        return self._value_between(bisect_right(self.times, time), time)

    def continue_with(self, piece: Curve) -> None:
        """Replace the values from the start of a piece on by the piece."""
        start = piece[0][0]
        index = bisect_left(self.times, start)
        last_value = self._value_between(index, start)
        self.times[index:] = [start, *(time for time, _ in piece)]
        self.values[index:] = [last_value, *(value for _, value in piece)]

    def _value_between(self, index: int, time: float) -> float:
        """Return the value at a time between the points before an index and at it."""
        if index in (0, len(self.times)):
            return self.values[max(index - 1, 0)]
        start, end = self.times[index - 1 : index + 1]
        first, last = self.values[index - 1 : index + 1]
        share = (time - start) / (end - start)
        return first + share * (last - first)

    def curve(self) -> Curve:
        """Return the points."""
        return tuple(zip(self.times, self.values, strict=True))


_Controls: TypeAlias = Mapping[str, _Control]


class _AhapReading:
    """Collects the events and parameters of a file, and counts clamped or skipped ones."""

    def __init__(self) -> None:
        self.end = 0.0  # s, of the events so far
        self.count = 0  # points so far
        self._events: list[_HapticEvent] = []
        self._pieces: dict[str, list[Curve]] = {name: [] for name in _CONTROL}  # of controls
        self._skipped: Counter[tuple[str, str]] = Counter()  # by singular and plural
        self._audio_parameters: Counter[str] = Counter()
        self._unknown_parameters: Counter[str] = Counter()
        self._clamped: dict[str, list[float]] = {}

    def add(self, entry: _PatternEntry) -> None:
        """Add an entry of a pattern."""
        if entry.Event is not None:
            self._add_event(entry.Event)
        parameter = entry.Parameter
        if parameter is not None:
            point = _ControlPoint(ParameterValue=parameter.ParameterValue)
            self._add_piece(parameter.ParameterID, parameter.Time, [point])
        curve = entry.ParameterCurve
        if curve is not None:
            self._add_piece(curve.ParameterID, curve.Time, curve.ParameterCurveControlPoints)

    def _add_event(self, event: _EventEntry) -> None:
        self.count += 1
        if event.EventType.startswith(_AUDIO):
            self._skipped["audio event", "audio events"] += 1
            return
        parameters = self._parameters_of(event)
        start = self._in_range("Time", event.Time, 0.0, _MAX_TIME)
        duration = self._in_range("EventDuration", event.EventDuration, 0.0, _MAX_TIME)
        is_transient = event.EventType == "HapticTransient"
        if is_transient:
            if any(parameters[name] != _EVENT[name].default for name in _ENVELOPE):
                self._skipped["envelope of a transient", "envelopes of transients"] += 1
            if duration:
                self._skipped["duration of a transient", "durations of transients"] += 1
            duration = 0.0
        end = start + duration
        self._events.append(_HapticEvent(is_transient, start, end, parameters))
        self.end = max(self.end, end)

    def _parameters_of(self, event: _EventEntry) -> dict[str, float]:
        """Return the values of all parameters of an event."""
        parameters = {name: bounds.default for name, bounds in _EVENT.items()}
        for entry in event.EventParameters:
            name = entry.ParameterID
            if name not in _EVENT:
                self._leave_out(name)
            elif entry.ParameterValue is not None:
                low, high, _ = _EVENT[name]
                parameters[name] = self._in_range(name, entry.ParameterValue, low, high)
        return parameters

    def _add_piece(self, name: str, start: float, points: Sequence[_ControlPoint]) -> None:
        """Add points of a dynamic parameter; their times count from a start [s]."""
        self.count += len(points)
        start = self._in_range("Time", start, 0.0, _MAX_TIME)
        if name not in _CONTROL:
            self._leave_out(name)
            return
        low, high, default = _CONTROL[name]
        piece = []
        for point in points:
            time = start + self._in_range("Time", point.Time, 0.0, _MAX_TIME)
            value = default
            if point.ParameterValue is not None:
                value = self._in_range(name, point.ParameterValue, low, high)
            piece.append((time, value))
        if piece:
            piece.sort(key=itemgetter(0))
            self._pieces[name].append(piece)
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

    def pattern(self, source: str, remarks: tuple[str, ...]) -> Pattern:
        """Return the pattern of all events; remarks: added after the remarks of the reading."""
        controls = {name: self._control(name) for name in _CONTROL}
        segments: list[Segment] = []
        transients = []
        for event in self._events:
            if event.is_transient:
                transients.append(_transient(event, controls))
            else:
                segments += _segments(event, controls)
        transients.sort(key=attrgetter("time"))
        intensity, sharpness = mixed(
            source,
            segments,
            factor=controls["HapticIntensityControl"].curve(),
            addend=controls["HapticSharpnessControl"].curve(),
        )
        ends = [transient.time for transient in transients[-1:]]
        ends += [time for time, _ in intensity[-1:]]
        return Pattern(
            max(ends, default=0.0),
            intensity,
            sharpness,
            tuple(transients),
            (*self._remarks(), *remarks),
        )

    def _control(self, name: str) -> _Control:
        """Join the pieces of a dynamic parameter; each piece lasts until the next one starts."""
        control = _Control([0.0], [_CONTROL[name].default])
        for piece in sorted(self._pieces[name], key=_start_of):
            control.continue_with(piece)
        return control

    def _remarks(self) -> tuple[str, ...]:
        """Return a remark for each kind of entry that was left out or clamped."""
        if all(event.is_transient for event in self._events):
            for name in _ENVELOPE_CONTROLS:
                self._skipped[name, f"{name}s"] += len(self._pieces[name])
        valid_names = (*_EVENT, *_CONTROL)
        remarks = [
            *names_remark("unknown parameter", self._unknown_parameters, valid_names=valid_names),
            *names_remark("audio parameter", self._audio_parameters),
        ]
        for (thing, things), count in self._skipped.items():
            if count:
                remarks.append(f"{counted(count, thing, plural=things)} left out")
        for name, values in self._clamped.items():
            values_text = counted(len(values), "value")
            remarks.append(f"{name}: {values_text} out of range clamped, got {_span(values)}")
        return tuple(remarks)


def _start_of(piece: Curve) -> float:
    return piece[0][0]


def _span(values: Sequence[float]) -> str:
    """Format the range of values, or a single value."""
    lowest = min(values)
    highest = max(values)
    return f"{lowest:g}" if lowest == highest else f"{lowest:g} to {highest:g}"


def _transient(event: _HapticEvent, controls: _Controls) -> Transient:
    """Return the transient of an event."""
    intensity_control = controls["HapticIntensityControl"].value_at(event.start)
    sharpness_control = controls["HapticSharpnessControl"].value_at(event.start)
    intensity = event.parameters["HapticIntensity"] * intensity_control
    sharpness = event.parameters["HapticSharpness"] + sharpness_control
    return Transient(event.start, intensity, min(max(sharpness, 0.0), 1.0))


def _segments(event: _HapticEvent, controls: _Controls) -> list[Segment]:
    """Return attack and plateau or decay, and release, of a continuous event."""
    attack = _phase_duration(event, "Attack", controls)
    decay = _phase_duration(event, "Decay", controls)
    release = _phase_duration(event, "Release", controls)
    level = event.parameters["HapticIntensity"]
    sharpness = event.parameters["HapticSharpness"]
    start = event.start
    end = event.end
    attack_end = min(start + attack, end)
    peak = level * (attack_end - start) / attack if attack else level
    segments = [(start, attack_end, 0.0, peak, sharpness, sharpness)]
    if event.parameters["Sustained"] >= 0.5:
        segments.append((attack_end, end, peak, peak, sharpness, sharpness))
        segments.append((end, end + release, peak, 0.0, sharpness, sharpness))
    elif decay:
        decay_end = min(attack_end + decay, end)
        remainder = peak * (1 - (decay_end - attack_end) / decay)
        segments.append((attack_end, decay_end, peak, remainder, sharpness, sharpness))
    return segments


def _phase_duration(event: _HapticEvent, phase: str, controls: _Controls) -> float:
    """Return the duration [s] of the attack, decay or release of an event."""
    control = controls[f"Haptic{phase}TimeControl"].value_at(event.start)
    value = event.parameters[f"{phase}Time"] + control
    return 0.01 * 100.0 ** min(value, 1.0) if value > 0 else 0.0

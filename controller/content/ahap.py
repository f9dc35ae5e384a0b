"""AHAP, the haptic and audio patterns of Apple, version 1, as Apple documents it.

Missing values have their defaults, those out of range are clamped, unknown keys are ignored, and
trailing commas pass; what was clamped, ignored or left out is in the remarks. Sources: Apple,
"Representing haptic patterns in AHAP files", and the header CHHapticParameter.h. Apple publishes
neither the defaults of HapticIntensity and HapticSharpness, here 1 (no attenuation) and 0.5, nor
times of AttackTime, DecayTime and ReleaseTime in seconds, here 10 ms times 100 to that power; 0,
the shortest, is none.
"""

from bisect import bisect_left, bisect_right
from collections import Counter
from operator import attrgetter, itemgetter
from typing import Annotated, Literal, TypeAlias

from pydantic import Field

from controller.content.format import ContentFormat, too_much
from controller.content.json_file import ContentSection, Entries, read_json, unknown_keys
from controller.content.mixing import Segment, mixed
from controller.content.pattern import Curve, Pattern, Transient
from model.config.fields import Validation
from model.quantities import counted

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

_PHASES = ("AttackTime", "DecayTime", "ReleaseTime")
_LASTING = (*_PHASES, "Sustained")  # without effect on a transient

_MAX_TIME = 1e6  # s; of a parameter that comes after all events

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
        """Return its haptic events under their dynamic parameters and curves."""
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
    """Collects events and parameters of a file, and what of them was clamped or left out."""

    def __init__(self) -> None:
        self.end = 0.0  # s, of the events so far
        self.count = 0  # points so far
        self._events: list[tuple[_Event, dict[str, float]]] = []
        self._controls: dict[str, list[Curve]] = {name: [] for name in _CONTROL}
        self._skipped: Counter[tuple[str, str]] = Counter()
        self._clamped: dict[str, list[float]] = {}

    def add(self, entry: _Entry) -> None:
        """Take an entry of a pattern."""
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
        if event.EventType.startswith("Audio"):
            self._skipped["audio event", "audio events"] += 1
            return
        values = {name: default for name, (_, _, default) in _EVENT.items()}
        for each in event.EventParameters:
            if each.ParameterID not in _EVENT:
                self._skipped["unknown parameter", "unknown parameters"] += 1
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
            self._skipped["unknown parameter", "unknown parameters"] += 1
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

    def _in_range(self, name: str, value: float, low: float, high: float) -> float:
        if low <= value <= high:
            return value
        self._clamped.setdefault(name, []).append(value)
        return min(max(value, low), high)

    def result(self, source: str) -> tuple[Curve, Curve, tuple[Transient, ...]]:
        """Return the intensity and sharpness of what lasts, and the transients in order."""
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
        """Return in words what was left out and clamped."""
        lasts = any(event.EventType == "HapticContinuous" for event, _ in self._events)
        for name in [] if lasts else [f"Haptic{each}Control" for each in _PHASES]:
            self._skipped[name, f"{name}s"] += len(self._controls[name])
        skipped = [
            f"{counted(n, what, plural=plural)} left out"
            for (what, plural), n in self._skipped.items()
            if n
        ]
        clamped = [
            f"{name}: {counted(len(values), 'value')} out of range clamped, "
            f"from {min(values):g} to {max(values):g}"
            for name, values in self._clamped.items()
        ]
        return (*skipped, *clamped)


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
    """Return the time [s] that an attack, decay or release value stands for."""
    return 0.01 * 100.0 ** min(value, 1.0) if value > 0 else 0.0


def _joined(pieces: list[Curve], default: float) -> _Control:
    """Return one curve of pieces, each of which goes on until the next begins."""
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

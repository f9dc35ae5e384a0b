""".haptic files of Haptics Studio and NiceVibrations, version 1.

Intensity is the square root of an amplitude, and the sharpness of a continuous event the square
root of a frequency. The format's own converter to AHAP computes the same (NiceVibrations,
core/datamodel/src/ios/v1.rs); files that the converter rejects are rejected here. Unknown keys of
later minor versions are ignored.
"""

import math
from collections.abc import Sequence
from typing import Annotated

from pydantic import Field

from controller.content.pattern import Pattern, Transient
from controller.content.reading import (
    ContentFormat,
    ContentSection,
    Entries,
    read_json,
    too_much,
    unknown_keys,
)
from model.config.document import KeyPath
from model.config.fields import Validation

_Share = Annotated[float, Field(ge=0, le=1)]
_Time = Annotated[float, Field(ge=0)]

_ENVELOPES: KeyPath = ("signals", "continuous", "envelopes")


class _Version(ContentSection):
    major: float
    minor: float = 0
    patch: float = 0


class _Emphasis(ContentSection):
    amplitude: _Share
    frequency: _Share


class _Breakpoint(ContentSection):
    time: _Time


class _AmplitudePoint(_Breakpoint):
    amplitude: _Share
    emphasis: _Emphasis | None = None


class _FrequencyPoint(_Breakpoint):
    frequency: _Share


class _Envelopes(ContentSection):
    amplitude: Annotated[Entries[_AmplitudePoint], Field(min_length=1)]
    frequency: Entries[_FrequencyPoint] | None = None


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
        version_check = Validation(document, _HapticVersion)
        major = version_check.finish().version.major
        if major != 1:
            version_check.add(
                ("version", "major"),
                f"must be 1, got {major:g}; export the content with a program that writes "
                "version 1",
            )
        version_check.finish()
        validation = Validation(document, _HapticFile)
        file = validation.finish()
        envelopes = file.signals.continuous.envelopes
        _check_times(validation, envelopes)
        _check_emphases(validation, envelopes.amplitude)
        validation.finish()
        intensity = []
        transients = []
        for point in envelopes.amplitude:
            intensity.append((point.time, math.sqrt(point.amplitude)))
            emphasis = point.emphasis
            if emphasis is not None:
                strength = math.sqrt(emphasis.amplitude)
                transients.append(Transient(point.time, strength, emphasis.frequency))
        frequencies = envelopes.frequency or []
        sharpness = [(point.time, math.sqrt(point.frequency)) for point in frequencies]
        duration = envelopes.amplitude[-1].time
        return Pattern(duration, intensity, sharpness, tuple(transients), unknown_keys(file))


def _check_times(validation: Validation[_HapticFile], envelopes: _Envelopes) -> None:
    """Check that times ascend in both envelopes, and that the longer one is not too long."""
    frequencies = envelopes.frequency or []
    amplitudes = envelopes.amplitude
    _check_order(validation, (*_ENVELOPES, "frequency"), frequencies)
    _check_order(validation, (*_ENVELOPES, "amplitude"), amplitudes)
    end = amplitudes[-1].time
    path: KeyPath = (*_ENVELOPES, "amplitude", len(amplitudes) - 1)
    if frequencies and frequencies[-1].time > end:
        end = frequencies[-1].time
        path = (*_ENVELOPES, "frequency", len(frequencies) - 1)
    problem = too_much(end, 0)
    if problem:
        validation.add(path, problem)


def _check_order(
    validation: Validation[_HapticFile], path: KeyPath, points: Sequence[_Breakpoint]
) -> None:
    """Check that the times of points ascend."""
    last_time = 0.0
    for index, point in enumerate(points):
        time = point.time
        if time < last_time:
            message = f"must be at least {last_time:g}, as at the previous point, got {time:g}"
            validation.add((*path, index, "time"), message)
            return
        last_time = time


def _check_emphases(
    validation: Validation[_HapticFile], amplitudes: Sequence[_AmplitudePoint]
) -> None:
    """Check that each emphasis is at least as strong as the envelope."""
    for index, point in enumerate(amplitudes):
        emphasis = point.emphasis
        if emphasis is not None and emphasis.amplitude < point.amplitude:
            validation.add(
                (*_ENVELOPES, "amplitude", index, "emphasis", "amplitude"),
                f"must be at least the amplitude there, {point.amplitude:g}, "
                f"got {emphasis.amplitude:g}",
            )
            return

"""The .haptic files of Haptics Studio and NiceVibrations, version 1.

Intensity is the root of an amplitude, and the sharpness of what lasts the root of a frequency, as
in the format's own converter to AHAP (NiceVibrations, core/datamodel/src/ios/v1.rs); what that file
refuses is refused here. Unknown keys, of later minor versions, are ignored.
"""

import math
from typing import Annotated

from pydantic import Field

from controller.content.format import ContentFormat, too_much
from controller.content.json_file import ContentSection, Entries, read_json, unknown_keys
from controller.content.pattern import Pattern, Transient
from model.config.document import KeyPath
from model.config.fields import Validation

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
        """Return its envelopes as curves, and its emphases as transients."""
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
    """Check that no time is before the one ahead of it."""
    before = 0.0
    for index, time in enumerate(times):
        if time < before:
            message = f"must be at least that of the point before, {before:g}, got {time:g}"
            validation.add((*path, index, "time"), message)
            return
        before = time

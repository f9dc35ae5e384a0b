"""Content format for amplitudes at equal intervals, like XR_FB_haptic_amplitude_envelope."""

from typing import Annotated

from pydantic import Field

from era_haptics.plugins.content_formats import (
    ContentFormat,
    ContentSection,
    Entries,
    Pattern,
    Validation,
    read_json,
)


class EnvelopeFile(ContentSection):
    """The keys of a file; invalid values are rejected with their line number."""

    duration_ns: Annotated[float, Field(gt=0, le=60e9)]
    amplitudes: Annotated[Entries[Annotated[float, Field(ge=0, le=1)]], Field(min_length=1)]


class AmplitudeEnvelope(ContentFormat):
    """JSON file with a duration and a list of amplitudes of equal length."""

    ending = "example.json"

    def read(self, content: bytes, source: str, channel: int) -> Pattern:
        """Return a pattern that reaches each amplitude in the middle of its interval."""
        file = Validation(read_json(content, source), EnvelopeFile).finish()
        duration = file.duration_ns * 1e-9
        step = duration / len(file.amplitudes)
        points = [(0.0, file.amplitudes[0])]
        for number, amplitude in enumerate(file.amplitudes):
            points.append(((number + 0.5) * step, amplitude))
        points.append((duration, file.amplitudes[-1]))
        return Pattern(duration, tuple(points))

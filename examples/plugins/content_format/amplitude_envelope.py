"""Content as XR_FB_haptic_amplitude_envelope has it, as JSON: a duration and even amplitudes."""

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
    """The keys of a file; what is not as they say is refused with its line."""

    duration_ns: Annotated[float, Field(gt=0, le=60e9)]
    amplitudes: Annotated[Entries[Annotated[float, Field(ge=0, le=1)]], Field(min_length=1)]


class AmplitudeEnvelope(ContentFormat):
    """One amplitude after another, each as long as the others."""

    ending = "example.json"

    def read(self, content: bytes, source: str, channel: int) -> Pattern:
        """Return a pattern whose intensity is each amplitude in the middle of its time."""
        file = Validation(read_json(content, source), EnvelopeFile).finish()
        duration = file.duration_ns * 1e-9
        step = duration / len(file.amplitudes)
        points = [((n + 0.5) * step, each) for n, each in enumerate(file.amplitudes)]
        ends = (0.0, file.amplitudes[0]), (duration, file.amplitudes[-1])
        return Pattern(duration, (ends[0], *points, ends[1]))

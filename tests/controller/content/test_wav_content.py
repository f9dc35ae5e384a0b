"""WAV files of sines, whose level and frequency are known."""

import io
import struct
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from scipy.io import wavfile

from controller.content.pattern import Pattern
from model.arrays import FloatArray
from model.errors import InputError

Read = Callable[..., Pattern]
TIME = np.arange(44_100) / 44_100


def wav(signal: Any, rate: int = 44_100) -> bytes:
    """A file of samples."""
    file = io.BytesIO()
    wavfile.write(file, rate, signal)
    return file.getvalue()


def sine(amplitude: float, frequency: float) -> FloatArray:
    """A second of it."""
    return np.asarray(amplitude * np.sin(2 * np.pi * frequency * TIME))


def course(pattern: Pattern) -> tuple[FloatArray, FloatArray]:
    """Intensity and sharpness each 10 ms, without the ends."""
    at = np.arange(0.1, 0.9, 0.01)
    intensity, sharpness = (np.array(c).T for c in (pattern.intensity, pattern.sharpness))
    return np.interp(at, *intensity), np.interp(at, *sharpness)


@pytest.mark.parametrize(
    ("scale", "shift", "kind"),
    [
        (127, 128, np.uint8),
        (32767, 0, np.int16),
        (2**31 - 256, 0, np.int32),
        (1, 0, np.float32),
        (1, 0, np.float64),
    ],
)
def test_intensity_is_the_amplitude_of_full_scale(
    read: Read, scale: int, shift: int, kind: type
) -> None:
    """A sine of half of it at 150 Hz has intensity 0.5 and sharpness (150 - 65) / 235."""
    samples = (sine(0.5, 150) * scale + shift).astype(kind)
    pattern = read("wav", wav(np.stack([samples * 0 + kind(shift), samples], axis=1)), channel=2)
    intensity, sharpness = course(pattern)
    assert intensity == pytest.approx(0.5, abs=0.01)
    assert sharpness == pytest.approx(85 / 235, abs=0.01)
    assert pattern.duration == 1
    assert pattern.remarks[0] == "channel 2 of 2 read"


def test_two_bands_and_what_lies_outside(read: Read) -> None:
    """0.6 and 0.3 are 0.67 at the frequency of the stronger; of 1 kHz the energy is said.

    That of 0.67 at 1 kHz is half of all, -3 dB.
    """
    felt = sine(0.6, 90) + sine(0.3, 250)
    pattern = read("wav", wav((felt + sine(0.45**0.5, 1000)).astype(np.float32)))
    intensity, sharpness = course(pattern)
    assert intensity == pytest.approx(0.45**0.5, abs=0.01)
    assert sharpness == pytest.approx(25 / 235, abs=0.01)
    assert pattern.out_of_band_share == pytest.approx(0.5, abs=0.01)
    assert pattern.remarks == ("50 % of its energy (-3.0 dB) is outside 65 to 300 Hz and left out",)


@pytest.mark.parametrize(
    ("rate", "seconds", "start", "end"),
    [
        (44_100, 1, 0.3, 0.5),
        (1009, 53, 50.0, 50.2),  # a prime, over as long as a file of 48 kHz has it
    ],
)
def test_burst_begins_and_ends_in_time(
    read: Read, rate: int, seconds: int, start: float, end: float
) -> None:
    """Half of its intensity is passed within 10 ms of both; silence is 0."""
    time = np.arange(rate * seconds) / rate
    signal = np.where((time > start) & (time < end), 0.8 * np.sin(2 * np.pi * 150 * time), 0)
    times, values = np.array(read("wav", wav(signal.astype(np.float32), rate)).intensity).T
    at = np.arange(start - 0.3, end + 0.3, 0.001)
    is_on = np.interp(at, times, values) > 0.4
    assert at[is_on.argmax()] == pytest.approx(start, abs=0.01)
    assert at[len(at) - is_on[::-1].argmax()] == pytest.approx(end, abs=0.01)
    assert values.max() == pytest.approx(0.8, abs=0.03)
    assert not values[(times < start - 0.05) | (times > end + 0.05)].any()


def chunk(name: bytes, content: bytes, size: int | None = None, order: str = "<") -> bytes:
    """A chunk as the specification has it; size: what it says of itself."""
    stated = len(content) if size is None else size
    return name + struct.pack(f"{order}I", stated) + content + b"\0" * (len(content) % 2)


def riff(*chunks: bytes, size: int | None = None, head: bytes = b"RIFF", order: str = "<") -> bytes:
    """A file of chunks; size: what it says of itself."""
    return chunk(head, b"WAVE" + b"".join(chunks), size, order)


def pcm(bits: int, order: str = "<", extension: bytes = b"") -> bytes:
    """The format of 44.1 kHz, one channel; extension: of another code than PCM."""
    code, size = (0xFFFE if extension else 1), bits // 8
    given = struct.pack(f"{order}HHIIHH", code, 1, 44_100, 44_100 * size, size, bits)
    return chunk(b"fmt ", given + extension, order=order)


SAMPLES = (sine(0.5, 150) * 32767).astype("<i2").tobytes()
LONG = chunk(b"ds64", struct.pack("<QQQI", 0, len(SAMPLES), 0, 0))
GUID = struct.pack("<HHIH", 22, 16, 4, 1) + bytes.fromhex("000000001000800000aa00389b71")


@pytest.mark.parametrize(
    "content",
    [
        riff(pcm(16), chunk(b"data", SAMPLES, 2**32 - 1), size=2**32 - 1),
        riff(pcm(16), chunk(b"LIST", b"INFO?"), chunk(b"data", SAMPLES, 2**32 - 1)),
        riff(pcm(16), chunk(b"data", SAMPLES, 2**31 - 1), size=2**31 - 1),
        riff(pcm(16), chunk(b"data", SAMPLES, 2**31 - 1 - 36), size=2**31 - 1),
        riff(pcm(16), chunk(b"data", SAMPLES, 0), size=0),
        riff(pcm(16), chunk(b"data", SAMPLES, 0), size=36),
        riff(pcm(16), chunk(b"data", SAMPLES), size=0),
        riff(pcm(16), chunk(b"data", SAMPLES), chunk(b"LIST", b"\x7f\x7f" * 999)),
        riff(pcm(16), chunk(b"data", SAMPLES, 2**32 - 1)) + b"\1",
        riff(LONG, pcm(16), chunk(b"data", SAMPLES, 2**32 - 1), LONG, head=b"RF64"),
        riff(pcm(16, extension=GUID), chunk(b"data", SAMPLES)),
        riff(
            pcm(16, ">"),
            chunk(b"data", np.frombuffer(SAMPLES, "<i2").astype(">i2").tobytes(), order=">"),
            head=b"RIFX",
            order=">",
        ),
        riff(
            pcm(24),
            chunk(b"data", np.pad(np.frombuffer(SAMPLES, "u1").reshape(-1, 2), ((0, 0), (1, 0)))
                  .tobytes()),
        ),
    ],
    ids=[
        "pipe", "pipe with a list", "31 bits", "31 bits less a head", "no sizes", "empty file",
        "no size", "list behind", "byte behind", "RF64", "extensible", "RIFX", "24 bits",
    ],
)  # fmt: skip
def test_files_are_read_whole_whatever_their_sizes_say(read: Read, content: bytes) -> None:
    """A second of 150 Hz, as pipes, recorders without power and other programs leave it."""
    pattern = read("wav", content)
    intensity, sharpness = course(pattern)
    assert intensity == pytest.approx(0.5, abs=0.01)
    assert sharpness == pytest.approx(85 / 235, abs=0.01)
    assert pattern.duration == 1


@pytest.mark.parametrize(
    ("content", "channel", "words"),
    [
        (b"RIFF", None, "must begin with RIFF and WAVE"),
        (b"\0" * 999, None, "must begin with RIFF and WAVE"),
        (riff(), None, "has no format, or no samples"),
        (riff(chunk(b"data", SAMPLES)), None, "has no format"),
        (riff(pcm(16)[:12], chunk(b"data", SAMPLES)), None, "has no format"),
        (riff(pcm(40), chunk(b"data", SAMPLES)), None, "got format 1, 1 channels of 40 bits"),
        (riff(pcm(16, extension=b"\6" * 9), chunk(b"data", SAMPLES)), None, "got format 65534"),
        (riff(chunk(b"fmt ", bytes(16)), chunk(b"data", SAMPLES)), None, "got format 0"),
        (wav(TIME.astype(np.float32))[:-100], None, "must have 176400 bytes of samples"),
        (wav(np.zeros((9, 3), np.int16)), None, "must have 1 or 2 channels, got 3"),
        (wav(np.zeros(9, np.int16)), 2, "channel must be 1 to 1, got 2"),
        (wav(np.zeros(0, np.int16)), None, "has no samples"),
        (wav(np.zeros(9, np.int16), 500), None, "sample rate must be 1000 to 192000 Hz, got 500"),
        (wav(np.zeros(61_000, np.int16), 1000), None, "must end within 60 s, got 61 s"),
        (wav(np.array([0, np.nan], np.float32)), None, "sample 1 must be -1 to 1"),
    ],
)
def test_refusal(read: Read, content: bytes, channel: int | None, words: str) -> None:
    """A damaged file, and what is beyond the bounds."""
    with pytest.raises(InputError, match=words):
        read("wav", content, channel)

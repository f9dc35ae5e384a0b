"""WAV files with sines, whose level and frequency are known, and files of other programs."""

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


def wav_file(samples: Any, rate: int = 44_100) -> bytes:
    """Return a file with samples."""
    file = io.BytesIO()
    wavfile.write(file, rate, samples)
    return file.getvalue()


def sine(amplitude: float, frequency: float) -> FloatArray:
    """Return a second of a sine."""
    return np.asarray(amplitude * np.sin(2 * np.pi * frequency * TIME))


def courses(pattern: Pattern) -> tuple[FloatArray, FloatArray]:
    """Return intensity and sharpness every 10 ms, without both ends."""
    times = np.arange(0.1, 0.9, 0.01)
    intensity_times, intensities = np.array(pattern.intensity).T
    sharpness_times, sharpnesses = np.array(pattern.sharpness).T
    intensity = np.interp(times, intensity_times, intensities)
    sharpness = np.interp(times, sharpness_times, sharpnesses)
    return intensity, sharpness


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
def test_wav_intensity_is_the_amplitude_relative_to_full_scale(
    read: Read, scale: int, shift: int, kind: type
) -> None:
    """A sine of half of it at 150 Hz has intensity 0.5 and sharpness (150 - 65) / 235."""
    samples = (sine(0.5, 150) * scale + shift).astype(kind)
    silence = np.full_like(samples, shift)

    pattern = read("wav", wav_file(np.stack([silence, samples], axis=1)), channel=2)

    intensity, sharpness = courses(pattern)
    assert intensity == pytest.approx(0.5, abs=0.01)
    assert sharpness == pytest.approx(85 / 235, abs=0.01)
    assert pattern.duration == 1
    assert pattern.remarks[0] == "channel 2 of 2 read"


def test_wav_bands_are_added_and_energy_outside_them_is_reported(read: Read) -> None:
    """0.6 and 0.3 are 0.67 at the frequency of the stronger; 0.67 at 1 kHz is half the energy."""
    felt = sine(0.6, 90) + sine(0.3, 250)
    outside = sine(0.45**0.5, 1000)

    pattern = read("wav", wav_file((felt + outside).astype(np.float32)))

    intensity, sharpness = courses(pattern)
    assert intensity == pytest.approx(0.45**0.5, abs=0.01)
    assert sharpness == pytest.approx(25 / 235, abs=0.01)
    assert pattern.out_of_band_share == pytest.approx(0.5, abs=0.01)
    assert pattern.remarks == ("50 % of its energy (-3.0 dB) is outside 65 to 300 Hz and left out",)


def chunk(name: bytes, content: bytes, size: int | None = None, order: str = "<") -> bytes:
    """Return a chunk of the specification; size: the stated one, None for the true one."""
    stated = len(content) if size is None else size
    return name + struct.pack(f"{order}I", stated) + content + b"\0" * (len(content) % 2)


def riff(*chunks: bytes, size: int | None = None, head: bytes = b"RIFF", order: str = "<") -> bytes:
    """Return a file of chunks; size: the stated one, None for the true one."""
    return chunk(head, b"WAVE" + b"".join(chunks), size, order)


def pcm(bits: int, order: str = "<", extension: bytes = b"") -> bytes:
    """Return the format of one channel at 44.1 kHz; extension: of a format other than PCM."""
    code = 0xFFFE if extension else 1
    size = bits // 8
    fields = struct.pack(f"{order}HHIIHH", code, 1, 44_100, 44_100 * size, size, bits)
    return chunk(b"fmt ", fields + extension, order=order)


SAMPLES = (sine(0.5, 150) * 32767).astype("<i2").tobytes()
LONG = chunk(b"ds64", struct.pack("<QQQI", 0, len(SAMPLES), 0, 0))
GUID = struct.pack("<HHIH", 22, 16, 4, 1) + bytes.fromhex("000000001000800000aa00389b71")


BIG_ENDIAN = np.frombuffer(SAMPLES, "<i2").astype(">i2").tobytes()
WITH_LOW_BYTE = np.pad(np.frombuffer(SAMPLES, "u1").reshape(-1, 2), ((0, 0), (1, 0))).tobytes()
UNKNOWN = 2**32 - 1
"""A size that a program states when it does not know it."""
FILES = {
    "pipe": riff(pcm(16), chunk(b"data", SAMPLES, UNKNOWN), size=UNKNOWN),
    "pipe with a list": riff(pcm(16), chunk(b"LIST", b"INFO?"), chunk(b"data", SAMPLES, UNKNOWN)),
    "31 bits": riff(pcm(16), chunk(b"data", SAMPLES, 2**31 - 1), size=2**31 - 1),
    "31 bits less a head": riff(pcm(16), chunk(b"data", SAMPLES, 2**31 - 1 - 36), size=2**31 - 1),
    "no sizes": riff(pcm(16), chunk(b"data", SAMPLES, 0), size=0),
    "size of an empty file": riff(pcm(16), chunk(b"data", SAMPLES, 0), size=36),
    "no size of the file": riff(pcm(16), chunk(b"data", SAMPLES), size=0),
    "list after the samples": riff(
        pcm(16), chunk(b"data", SAMPLES), chunk(b"LIST", b"\x7f\x7f" * 999)
    ),
    "byte after the samples": riff(pcm(16), chunk(b"data", SAMPLES, UNKNOWN)) + b"\1",
    "RF64": riff(LONG, pcm(16), chunk(b"data", SAMPLES, UNKNOWN), LONG, head=b"RF64"),
    "extensible": riff(pcm(16, extension=GUID), chunk(b"data", SAMPLES)),
    "RIFX": riff(pcm(16, ">"), chunk(b"data", BIG_ENDIAN, order=">"), head=b"RIFX", order=">"),
    "24 bits": riff(pcm(24), chunk(b"data", WITH_LOW_BYTE)),
}
"""A second of 150 Hz, as pipes, recorders that lost power and other programs leave it."""


@pytest.mark.parametrize("case", FILES)
def test_wav_file_is_read_completely_whatever_its_sizes_state(read: Read, case: str) -> None:
    """Intensity, frequency and duration are those of the samples."""
    pattern = read("wav", FILES[case])

    intensity, sharpness = courses(pattern)
    assert intensity == pytest.approx(0.5, abs=0.01)
    assert sharpness == pytest.approx(85 / 235, abs=0.01)
    assert pattern.duration == 1


DATA = chunk(b"data", SAMPLES)
INCOMPLETE = wav_file(TIME.astype(np.float32))[:-100]
REFUSED = {
    "short": (b"RIFF", "must begin with RIFF and WAVE"),
    "zeros": (b"\0" * 999, "must begin with RIFF and WAVE"),
    "empty": (riff(), "has no format, or no samples"),
    "no format": (riff(DATA), "has no format"),
    "cut format": (riff(pcm(16)[:12], DATA), "has no format"),
    "40 bits": (riff(pcm(40), DATA), "got format 1, 1 channels of 40 bits"),
    "short extension": (riff(pcm(16, extension=b"\6" * 9), DATA), "got format 65534"),
    "format 0": (riff(chunk(b"fmt ", bytes(16)), DATA), "got format 0"),
    "incomplete": (INCOMPLETE, "must have 176400 bytes of samples"),
    "three channels": (wav_file(np.zeros((9, 3), np.int16)), "must have 1 or 2 channels, got 3"),
    "no samples": (wav_file(np.zeros(0, np.int16)), "has no samples"),
    "slow": (
        wav_file(np.zeros(9, np.int16), 500),
        "sample rate must be 1000 to 192000 Hz, got 500",
    ),
    "long": (wav_file(np.zeros(61_000, np.int16), 1000), "must end within 60 s, got 61 s"),
    "not a number": (wav_file(np.array([0, np.nan], np.float32)), "sample 1 must be -1 to 1"),
}


@pytest.mark.parametrize("case", REFUSED)
def test_wav_file_is_refused(read: Read, case: str) -> None:
    """If it is damaged, or beyond the limits."""
    content, message = REFUSED[case]
    with pytest.raises(InputError, match=message):
        read("wav", content)


def test_wav_channel_is_refused_if_the_file_has_fewer(read: Read) -> None:
    """Of a file with one channel."""
    with pytest.raises(InputError, match="channel must be 1 to 1, got 2"):
        read("wav", wav_file(np.zeros(9, np.int16)), 2)

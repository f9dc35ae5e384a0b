"""A stepped sine that other programs have recorded or measured, against what made it."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest
from scipy.io import wavfile

from era_haptics.lab.measuring.loopback import read_stepped
from era_haptics.lab.measuring.sound_card import Desk
from model.arrays import ComplexArray, FloatArray
from model.calibration.responses import Responses, WiredSensor, responses_of
from model.errors import InputError
from model.rig.rig import Rig

RATE = 12_000
TONES = (61.0, 151.5, 311.0)
PLACES = ((0.03, 0.05), (0.20, 0.11))
FIXED = tuple(WiredSensor(f"P{n}", x, y, n, 2e-3) for n, (x, y) in enumerate(PLACES, start=1))
MOVED = tuple(WiredSensor(f"P{n}", x, y, 1, 2e-3, 2e-3) for n, (x, y) in enumerate(PLACES, start=1))


def ratio(tone: int, era: int, sensor: int) -> complex:
    """Sensor by reference, some number."""
    return complex((0.1 + 0.05 * tone) * np.exp(1j * (era - 2.5 * sensor + tone)))


def played(era: int, *, held: float) -> list[tuple[FloatArray, list[FloatArray]]]:
    """Reference and sensors of each tone of an ERA; sensors settle with a tenth of its time."""
    found = []
    times = np.arange(round(held * RATE)) / RATE
    for number, frequency in enumerate(TONES):
        angle = 2 * np.pi * frequency * times
        rise = 1 - np.exp(-times / (0.1 * held))
        heard = [
            rise * 0.5 * abs(r) * np.sin(angle + np.angle(r))
            for r in (ratio(number, era, sensor) for sensor in range(2))
        ]
        found.append((0.5 * np.sin(angle), heard))
    return found


def recording(
    path: Path,
    eras: Sequence[int],
    *,
    sensors: Sequence[int] = (0, 1),
    references: int,
    gap: float = 0.3,
    held: float = 1.5,
) -> None:
    """Write 16 bits of sensors and references, with noise of 0.1 % of full scale."""
    rng = np.random.default_rng([*path.stem.encode()])
    pieces = []
    for era in eras:
        for reference, heard in played(era, held=held):
            piece = np.zeros((len(reference) + round(gap * RATE), len(sensors) + references))
            for column, sensor in enumerate(sensors):
                piece[: len(reference), column] = heard[sensor]
            piece[: len(reference), len(sensors) + (era if references > 1 else 0)] = reference
            pieces.append(piece)
    samples = np.concatenate([np.zeros((RATE // 3, pieces[0].shape[1])), *pieces])
    samples += 1e-3 * rng.standard_normal(samples.shape)
    wavfile.write(path, RATE, (32767 * samples).astype(np.int16))


def expected(rig: Rig, sensor: int) -> ComplexArray:
    """Responses (f, eras) by hand: samples by samples, over stroke and sensitivity 2e-3."""
    strokes = [era.stroke for era in rig.eras]
    return np.array([[ratio(t, e, sensor) / 2e-3 / strokes[e] for e in range(4)] for t in range(3)])


def check(rig: Rig, found: Responses, *, rtol: float) -> None:
    """All values are what made them."""
    np.testing.assert_allclose(found.frequencies, TONES, rtol=2e-5)
    for sensor in range(2):
        column = found.sensors.index(f"P{sensor + 1}")
        np.testing.assert_allclose(found.values[:, :, column], expected(rig, sensor), rtol=rtol)


@pytest.mark.parametrize(("references", "gap"), [(4, 0.3), (4, 0.0), (1, 0.3), (1, 0.0)])
def test_recording_gives_what_each_sensor_heard(
    rig: Rig, tmp_path: Path, references: int, gap: float
) -> None:
    """A reference for each output, or one for all in turn; with and without silence between."""
    path = tmp_path / "steps.wav"
    recording(path, range(4), references=references, gap=gap)
    check(rig, responses_of(read_stepped(path, Desk(rig, FIXED)), rig), rtol=0.01)


def test_recordings_of_places_and_outputs_are_told_by_their_names(rig: Rig, tmp_path: Path) -> None:
    """Two channels: a sensor that is moved, a cable; a folder of PLACE-OUTPUT.wav, its mass too."""
    for sensor in range(2):
        for era in range(4):
            name = tmp_path / f"P{sensor + 1}-{era + 1}.wav"
            recording(name, [era], sensors=[sensor], references=1)
    found = responses_of(read_stepped(tmp_path, Desk(rig, MOVED)), rig)
    check(rig, found, rtol=0.01)
    assert found.masses is not None
    assert found.masses.tolist() == [2e-3, 2e-3]


def table(rig: Rig, form: str, separator: str) -> str:
    """All values as another program exports them."""
    columns = {
        "real": ("real", "imag"),
        "magnitude": ("magnitude", "phase_deg"),
        "db": ("magnitude_db", "phase_deg"),
    }[form]
    lines = [separator.join(["Frequency_Hz".lower(), "output", "sensor", *columns])]
    for t, tone in enumerate(TONES):
        for e, era in enumerate(rig.eras):
            for s in range(2):
                r = ratio(t, e, s)
                size, phase = abs(r), np.degrees(np.angle(r))
                pair = {
                    "real": (r.real, r.imag),
                    "magnitude": (size, phase),
                    "db": (20 * np.log10(size), phase),
                }[form]
                numbers = [f"{each:.9g}" for each in (tone, *pair)]
                if separator == ";":
                    numbers = [each.replace(".", ",") for each in numbers]
                output = str(e + 1) if form == "db" else era.name
                lines.append(separator.join([numbers[0], output, f"P{s + 1}", *numbers[1:]]))
    return "\n".join(lines) + "\n"


@pytest.mark.parametrize(
    ("form", "separator", "encoding"),
    [("real", ",", "utf-8"), ("magnitude", ";", "utf-8-sig"), ("db", "\t", "utf-16")],
)
def test_table_of_another_program_is_read(
    rig: Rig, tmp_path: Path, form: str, separator: str, encoding: str
) -> None:
    """Real parts, magnitudes, decibels; decimal commas and marks of byte order; names, numbers."""
    path = tmp_path / "steps.csv"
    path.write_text(table(rig, form, separator), encoding)
    check(rig, responses_of(read_stepped(path, Desk(rig, FIXED)), rig), rtol=1e-7)


def test_lines_of_a_file_stay_at_their_frequencies(rig: Rig, tmp_path: Path) -> None:
    """200 lines 0.05 Hz apart, nearer than clocks tell tones of recordings apart."""
    written = [250 + 0.05 * number for number in range(200)]
    rows = [f"{frequency:.2f},1,0" for frequency in written]
    (tmp_path / "P1-1.csv").write_text("\n".join(["frequency_hz,real,imag", *rows]))
    found = [each.frequency for each in read_stepped(tmp_path / "P1-1.csv", Desk(rig, FIXED))]
    assert found == pytest.approx(written, rel=1e-9)


def test_columns_that_are_not_there_are_in_the_name(rig: Rig, tmp_path: Path) -> None:
    """P2-SE.csv, frequency and response only."""
    (tmp_path / "P2-SE.csv").write_text("frequency_hz,magnitude,phase_deg\n61,0.2,90\n")
    (found,) = read_stepped(tmp_path, Desk(rig, FIXED))
    assert (found.sensor, found.era) == ("P2", "SE")
    assert found.value == pytest.approx(0.2j / 2e-3 / rig.era("SE").stroke)


@pytest.mark.parametrize(
    ("name", "text", "cause"),
    [
        ("a.csv", "frequency_hz,real,imag\n61,1,0\n", "column output, or a name"),
        ("P1-9.csv", "frequency_hz,real,imag\n61,1,0\n", ":2: output must be one of 1, .*SW"),
        ("P7-1.csv", "frequency_hz,real,imag\n61,1,0\n", ":2: sensor must be one of"),
        ("P1-1.csv", "frequency_hz,magnitude\n61,1\n", "with phase_deg, or real"),
        ("P1-1.csv", "frequency_hz,real,imag\n0,1,0\n", ":2: frequency_hz must be above"),
        ("P1-1.csv", "frequency_hz,magnitude,phase_deg\n61,-1,0\n", ":2: magnitude"),
        ("P1.txt", "", "must be a .csv or .wav"),
        ("P1.wav", "no sound", "no WAV file"),
    ],
)
def test_files_that_say_too_little_are_refused(
    rig: Rig, tmp_path: Path, name: str, text: str, cause: str
) -> None:
    """Without an output, of an unknown one, without phases, and no files at all."""
    (tmp_path / name).write_text(text)
    with pytest.raises(InputError, match=cause):
        read_stepped(tmp_path / name, Desk(rig, FIXED))


@pytest.mark.parametrize("held", [1.5, 10.0])
def test_a_distorted_reference_has_the_frequency_of_its_tone(
    rig: Rig, tmp_path: Path, held: float
) -> None:
    """A third harmonic of 10 and 20 %, and an offset of 10 %: tones are where they were played.

    Frames of 50 ms are no whole number of their periods.
    """
    for number, (third, offset) in enumerate([(0.1, 0.0), (0.2, 0.0), (0.0, 0.1)]):
        path = tmp_path / f"{number}.wav"
        recording(path, range(4), references=1, held=held)
        rate, samples = wavfile.read(path)
        reference = samples[:, 2] / 16384
        # sin 3a = 3 sin a - 4 sin³ a
        distorted = reference + third * (3 * reference - 4 * reference**3) + offset
        samples[:, 2] = 8000 * distorted
        wavfile.write(path, rate, samples)
        tones = {each.frequency for each in read_stepped(path, Desk(rig, FIXED))}
        assert sorted(tones) == pytest.approx(TONES, rel=2e-5)


def test_tones_that_cannot_be_told_are_refused_with_their_time(rig: Rig, tmp_path: Path) -> None:
    """Noise in the reference amid the second tone of the first ERA, which no tone is made of."""
    path = tmp_path / "steps.wav"
    recording(path, range(4), references=1)
    rate, samples = wavfile.read(path)
    noisy = slice(round(2.3 * rate), round(3.5 * rate))
    noise = np.random.default_rng(0).standard_normal(noisy.stop - noisy.start)
    samples[noisy, 2] += (3000 * noise).astype(np.int16)
    wavfile.write(path, rate, samples)
    with pytest.raises(InputError, match=r"at 2\.\d s: the reference must be one steady tone"):
        read_stepped(path, Desk(rig, FIXED))


def sweep() -> FloatArray:
    """A glide from 60 to 100 Hz in 10 s."""
    times = np.arange(10 * RATE) / RATE
    return np.asarray(0.4 * np.sin(2 * np.pi * (60 + 2 * times) * times))


@pytest.mark.parametrize(
    ("change", "cause"),
    [
        (lambda s: s[:, :3], "channels must be 2 of sensors and 1 or 4"),
        (lambda s: s * [1, 0, 1, 1, 1, 1], "silent: sensor P2"),
        (lambda s: s * [30, 1, 1, 1, 1, 1], "clipping of sensor P1"),
        (lambda s: s * [1, 1, 0, 0, 0, 0], "the reference is silent"),
        (lambda s: s[:, [0, 1, 2, 2, 2, 2]], "one output must play at a time"),
        (lambda s: s[: len(s) // 2], "tones must be of all of"),
        (lambda s: np.tile(sweep()[:, None], (1, 6)), "each tone must be held"),
    ],
)
def test_recordings_that_are_none_of_a_stepped_sine_are_refused(
    rig: Rig, tmp_path: Path, change: object, cause: str
) -> None:
    """Wrong channels, a missing sensor, clipping, no cable, all at once, too short, a sweep."""
    path = tmp_path / "steps.wav"
    recording(path, range(4), references=4)
    rate, samples = wavfile.read(path)
    changed = np.clip(change(samples / 32768), -1, 32767 / 32768)  # type: ignore[operator]
    if changed.shape[1] == 3:
        changed = np.column_stack([changed, changed[:, 2]])
    wavfile.write(path, rate, (changed * 32768).astype(np.int16))
    with pytest.raises(InputError, match=cause):
        read_stepped(path, Desk(rig, FIXED))


def test_tones_that_have_not_settled_are_left_out(rig: Rig, tmp_path: Path) -> None:
    """Held for 0.6 s, with a plate that takes 2 s: no value is made of what still rises."""
    path = tmp_path / "steps.wav"
    recording(path, range(4), references=4, held=0.6)
    rate, samples = wavfile.read(path)
    rising = samples.astype(float)
    times = np.arange(len(samples)) / rate
    rising[:, 0] *= np.exp(-((times % 0.9) / 0.5))
    wavfile.write(path, rate, rising.astype(np.int16))
    found = read_stepped(path, Desk(rig, FIXED))
    assert {each.sensor for each in found} == {"P2"}

"""Outputs and their actuators, and stepped sines in files.

Outputs are assigned by a person or by one accelerometer; sines are as other programs record or
measure them, compared with their source.
"""

import json
import shutil
from collections.abc import Callable, Sequence
from dataclasses import replace
from itertools import product
from pathlib import Path

import numpy as np
import pytest
from scipy.io import wavfile
from typer.testing import CliRunner

from cases import shortly
from era_haptics.lab.cli import app as cli_app
from era_haptics.lab.measuring.other_sources import read_stepped
from era_haptics.lab.measuring.outputs import OutputFinding, listen_to_outputs, matched, tone
from era_haptics.lab.measuring.sound_card import Desk, WiredSensor
from kit.desk_plate import Converters, DeskPlate, Truth
from kit.plates import exciter_rig
from model.arrays import ComplexArray, Float32Array, FloatArray
from model.errors import InputError
from model.estimate.measurement import Measurement, measurement_of
from model.reduction.free_plate import solve_free_plate
from model.rig.rig import Rig
from model.rig.rig_file import load_rig
from processes.sound_cards import DeskCard

RATE = 8_000.0

EXAMPLE = Path(__file__).parents[4] / "examples" / "desk" / "rig.yaml"
SENSITIVITY = 0.01  # that the command does not know


class Cabled(DeskCard):
    """Outputs wired to ERAs in another order, each with a gain; negative: wires exchanged.

    One input, of an accelerometer that is moved from place to place.
    """

    order: Sequence[int]
    gains: Sequence[float]
    place = -1

    def move(self, _name: str) -> None:
        """To the next place."""
        self.place += 1

    def run(self, played: FloatArray) -> Float32Array:
        """The loop-back's output is silent."""
        wired = np.zeros((len(played), 5))
        wired[:, self.order] = played * np.asarray(self.gains)
        return super().run(wired)[:, [self.place]]


def cabled(
    truth: Truth,
    *,
    order: Sequence[int] = (0, 1, 2, 3),
    gains: Sequence[float] = (1, 1, 1, 1),
    apart: float = 0.02,
) -> Cabled:
    """The deviating plate with a place as far [m] from each ERA, towards the middle."""
    sensors = []
    for n, era in enumerate(truth.rig.eras, start=1):
        way = np.array([truth.rig.plate.length / 2 - era.x, truth.rig.plate.width / 2 - era.y])
        x, y = np.array([era.x, era.y]) + min(apart / np.linalg.norm(way), 1) * way
        sensors.append(WiredSensor(f"A{n}", x, y, n, SENSITIVITY))
    plate = DeskPlate(truth, sensors, rate=RATE, converters=Converters(), seed=1)
    card = Cabled(plate, rate=RATE)
    card.order, card.gains = order, gains
    return card


def test_accelerometer_tells_swapped_backwards_dead_and_weak(rig: Rig, truth: Truth) -> None:
    """Of a plate that deviates from the rig, with an unknown delay: as it was wired here.

    One plays nothing, another a quarter as loud: 12 dB, to the 3 dB that plates deviate by. An
    accelerometer that stays in the middle has all four corners of a symmetric plate alike.
    """

    def heard(card: Cabled) -> list[OutputFinding]:
        return listen_to_outputs(Desk(rig, ()), card, 1, outputs=4, level=0.1, move=card.move)

    found = heard(cabled(truth, order=(0, 2, 1, 3), gains=(1, 1, -1, 1)))
    assert [each.era for each in found] == [rig.eras[n].name for n in (0, 2, 1, 3)]
    assert [each.polarity for each in found] == [1, 1, -1, 1]
    assert [each.verdict == "ok" for each in found] == [True, True, False, True]
    found = heard(cabled(truth, gains=(1, 0, 1, 0.25)))
    assert [each.era for each in found] == ["SW", None, "NE", "NW"]
    assert "dead" in found[1].verdict
    assert "loose" in found[3].verdict
    assert 20 * np.log10(found[3].relative_level) == pytest.approx(-12, abs=3)
    with pytest.raises(InputError, match="was moved each time"):
        heard(cabled(truth, apart=1.0))


def test_exciters_are_told_apart_on_a_board_of_the_shop() -> None:
    """12 boards that deviate: 10 % of E, 20 % of springs, 40 % of gains, 10 degrees, 25 mm."""
    nominal = exciter_rig()
    frequencies = np.arange(81.0, 261.0, 20.0)
    points = np.array([[each.x, each.y] for each in nominal.eras])
    rng = np.random.default_rng(0)
    model = _responses(nominal, points, frequencies)
    for _ in range(12):
        board = nominal.plate.material
        plate = replace(
            nominal.plate, material=replace(board, E=board.E * (1 + 0.1 * rng.normal()))
        )
        eras = tuple(each.varied(stiffness=np.exp(0.2 * rng.normal())) for each in nominal.eras)
        away = 0.025 * np.exp(2j * np.pi * rng.uniform(size=4))
        real = replace(nominal, plate=plate, eras=eras)
        values = _responses(real, points + np.stack([away.real, away.imag], axis=1), frequencies)
        order, signs = rng.permutation(4), rng.permutation([1, 1, 1, -1])
        gains = rng.uniform(0.6, 1.4, 4) * np.exp(1j * np.radians(10) * rng.normal(size=4))
        late = np.exp(-2j * np.pi * frequencies * 0.0042)
        played = values[order] * (signs * gains)[:, None, None] * late[:, None]
        rows, found, polarities = matched(played, model, frequencies)
        assert rows.tolist() == [0, 1, 2, 3]
        assert found.tolist() == order.tolist()
        assert polarities.tolist() == signs.tolist()


def _responses(rig: Rig, points: FloatArray, frequencies: FloatArray) -> ComplexArray:
    """Of each exciter, each frequency, at each place."""
    free = solve_free_plate(rig.plate, rig.mesh, frequency_max=300.0)
    return free.acceleration(rig.eras, frequencies, points, loads=rig.masses).transpose(1, 0, 2)


def test_tone_is_soft_on_one_output_within_the_limits(rig: Rig) -> None:
    """Largest sample and steepest rise by hand, others silent; a forbidden frequency is refused."""
    desk = Desk(rig, ())
    played = tone(desk, 3, outputs=4, rate=48_000, level=0.1, frequency=160.0)
    assert np.abs(played).max() == pytest.approx(0.1, rel=1e-3)
    assert not played[:, [0, 1, 3]].any()
    assert np.abs(np.diff(played, axis=0)).max() < 0.1 * 2 * np.pi * 160 / 48_000 * 1.01
    assert played[0, 2] == 0
    with pytest.raises(InputError, match="--frequency"):
        tone(desk, 1, outputs=4, rate=48_000, level=0.1, frequency=5.0)


@pytest.mark.parametrize(
    ("said", "channels", "status"),
    [
        ("SE\nr\nsw\nxx\nNE\nNW\n", {"SE": 0, "SW": 1, "NE": 2, "NW": 3}, 0),
        ("SW\nSE\n-\nNW\n", {"SW": 0, "SE": 1, "NW": 3}, 1),
    ],
)
def test_said_channels_are_written(
    truth: Truth,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    said: str,
    channels: dict[str, int],
    status: int,
) -> None:
    """As they were said, one asked again; with one that no output drives no file is written."""
    card = cabled(truth)
    monkeypatch.setattr("era_haptics.lab.measuring.outputs.open_card", lambda *_, **__: card)
    rig_file, output = tmp_path / "rig.yaml", tmp_path / "wired.yaml"
    shutil.copy(EXAMPLE, rig_file)
    done = CliRunner().invoke(
        cli_app,
        ["outputs", str(rig_file), "--device", "jack", "-o", str(output), "--json"],
        input=said,
    )
    assert done.exit_code == status
    answer = json.loads(done.stdout.splitlines()[-1])  # what is typed is echoed before
    assert answer["channels"] == channels
    assert output.exists() == (status == 0)
    if status == 0:
        wiring = load_rig(output).wiring
        assert {name: wired.number for name, wired in wiring.items()} == channels
        assert "base: rig.yaml" in output.read_text("utf-8")
    else:
        assert answer["missing"] == ["NE"]


FILE_RATE = 12_000
TONES = (61.0, 151.5, 311.0)
LOOPBACK_PLACES = ((0.03, 0.05), (0.20, 0.11))
FIXED = tuple(
    WiredSensor(f"P{n}", x, y, n, 2e-3) for n, (x, y) in enumerate(LOOPBACK_PLACES, start=1)
)
MOVED = tuple(
    WiredSensor(f"P{n}", x, y, 1, 2e-3, 2e-3) for n, (x, y) in enumerate(LOOPBACK_PLACES, start=1)
)


def ratio(tone: int, era: int, sensor: int) -> complex:
    """Sensor by reference, some number."""
    return complex((0.1 + 0.05 * tone) * np.exp(1j * (era - 2.5 * sensor + tone)))


def recording(
    path: Path,
    eras: Sequence[int],
    *,
    sensors: Sequence[int] = (0, 1),
    references: int,
    gap: float = 0.3,
    held: float = 1.5,
) -> None:
    """Write 16 bits of sensors and references, with noise of 0.1 % of full scale.

    Sensors settle with a tenth of the time for which each tone of an ERA is held.
    """
    rng = np.random.default_rng([*path.stem.encode()])
    times = np.arange(round(held * FILE_RATE)) / FILE_RATE
    rise = 0.5 * (1 - np.exp(-times / (0.1 * held)))
    pieces = [np.zeros((FILE_RATE // 3, len(sensors) + references))]
    for era, (number, frequency) in product(eras, enumerate(TONES)):
        angle = 2 * np.pi * frequency * times
        piece = np.zeros((len(times) + round(gap * FILE_RATE), len(sensors) + references))
        for column, sensor in enumerate(sensors):
            size = ratio(number, era, sensor)
            piece[: len(times), column] = rise * abs(size) * np.sin(angle + np.angle(size))
        reference = len(sensors) + (era if references > 1 else 0)
        piece[: len(times), reference] = 0.5 * np.sin(angle)
        pieces.append(piece)
    samples = np.concatenate(pieces)
    samples += 1e-3 * rng.standard_normal(samples.shape)
    wavfile.write(path, FILE_RATE, (32767 * samples).astype(np.int16))


def check(rig: Rig, found: Measurement, *, rtol: float) -> None:
    """All values are what made them: samples by samples, over stroke and sensitivity 2e-3."""
    np.testing.assert_allclose(found.frequencies, TONES, rtol=2e-5)
    strokes = [era.stroke for era in rig.eras]
    for sensor in range(2):
        column = found.values[:, found.names.index(f"P{sensor + 1}")]
        sizes = [[ratio(t, e, sensor) / 2e-3 / strokes[e] for e in range(4)] for t in range(3)]
        np.testing.assert_allclose(column, sizes, rtol=rtol)


@pytest.mark.parametrize(("references", "gap"), [(4, 0.3), (4, 0.0), (1, 0.3), (1, 0.0)])
def test_recording_gives_what_each_sensor_heard(
    rig: Rig, tmp_path: Path, references: int, gap: float
) -> None:
    """A reference for each output, or one for all in turn; with and without silence between."""
    path = tmp_path / "steps.wav"
    recording(path, range(4), references=references, gap=gap)
    check(rig, measurement_of(read_stepped(path, Desk(rig, FIXED)), rig), rtol=0.01)


def test_recordings_of_places_and_outputs_are_told_by_their_names(rig: Rig, tmp_path: Path) -> None:
    """Two channels: a sensor that is moved, a cable; a folder of PLACE-OUTPUT.wav, its mass too."""
    for sensor in range(2):
        for era in range(4):
            name = tmp_path / f"P{sensor + 1}-{era + 1}.wav"
            recording(name, [era], sensors=[sensor], references=1)
    found = measurement_of(read_stepped(tmp_path, Desk(rig, MOVED)), rig)
    check(rig, found, rtol=0.01)
    assert [each.mass for each in found.sensors] == [2e-3, 2e-3]


FORMS: dict[str, tuple[str, Callable[[complex], tuple[float, float]]]] = {
    "real": ("real,imag", lambda r: (r.real, r.imag)),
    "magnitude": ("magnitude,phase_deg", lambda r: (abs(r), np.degrees(np.angle(r)))),
    "db": ("magnitude_db,phase_deg", lambda r: (20 * np.log10(abs(r)), np.degrees(np.angle(r)))),
}
"""How other programs export a value: names of columns, and what is in them."""


def loopback_table(rig: Rig, form: str, separator: str) -> str:
    """All values as another program exports them."""
    columns, numbers_of = FORMS[form]
    rows = [["frequency_hz", "output", "sensor", *columns.split(",")]]
    for t, e, s in product(range(3), range(4), range(2)):
        numbers = [f"{each:.9g}" for each in (TONES[t], *numbers_of(ratio(t, e, s)))]
        if separator == ";":
            numbers = [each.replace(".", ",") for each in numbers]
        output = str(e + 1) if form == "db" else rig.eras[e].name
        rows.append([numbers[0], output, f"P{s + 1}", *numbers[1:]])
    return "\n".join(map(separator.join, rows)) + "\n"


@pytest.mark.parametrize(
    ("form", "separator", "encoding"),
    [("real", ",", "utf-8"), ("magnitude", ";", "utf-8-sig"), ("db", "\t", "utf-16")],
)
def test_table_of_another_program_is_read(
    rig: Rig, tmp_path: Path, form: str, separator: str, encoding: str
) -> None:
    """Real parts, magnitudes, decibels; decimal commas and marks of byte order; names, numbers."""
    path = tmp_path / "steps.csv"
    path.write_text(loopback_table(rig, form, separator), encoding)
    check(rig, measurement_of(read_stepped(path, Desk(rig, FIXED)), rig), rtol=1e-7)


def test_columns_that_are_not_there_are_in_the_name(rig: Rig, tmp_path: Path) -> None:
    """P2-SE.csv, frequency and response only."""
    (tmp_path / "P2-SE.csv").write_text("frequency_hz,magnitude,phase_deg\n61,0.2,90\n")
    (found,) = read_stepped(tmp_path, Desk(rig, FIXED))
    assert (found.sensor, found.era) == ("P2", "SE")
    assert found.value == pytest.approx(0.2j / 2e-3 / rig.era("SE").stroke)


@pytest.mark.parametrize("held", shortly([1.5, 10.0], [1.5]))
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


def sweep() -> FloatArray:
    """A glide from 60 to 100 Hz in 10 s."""
    times = np.arange(10 * FILE_RATE) / FILE_RATE
    return np.asarray(0.4 * np.sin(2 * np.pi * (60 + 2 * times) * times))


def noisy(samples: FloatArray) -> FloatArray:
    """Noise in the reference amid the second tone of the first ERA, which no tone is made of."""
    rows = slice(round(2.3 * FILE_RATE), round(3.5 * FILE_RATE))
    samples[rows, 2] += 0.1 * np.random.default_rng(0).standard_normal(rows.stop - rows.start)
    return samples


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
        pytest.param(noisy, r"at 2\.\d s: the reference must be one steady tone", id="noisy"),
    ],
)
def test_recordings_that_are_none_of_a_stepped_sine_are_refused(
    rig: Rig, tmp_path: Path, change: object, cause: str
) -> None:
    """Wrong channels, no sensor, clipping, no cable, all at once, too short, a sweep, noise."""
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
    rising[:, 0] *= np.exp(-(np.arange(len(samples)) / rate % 0.9) / 0.5)
    wavfile.write(path, rate, rising.astype(np.int16))
    found = read_stepped(path, Desk(rig, FIXED))
    assert {each.sensor for each in found} == {"P2"}


@pytest.mark.parametrize(
    ("rate", "channels", "words"),
    [
        (
            FILE_RATE,
            1,
            "channels must be 2 of sensors and 1 or 4 references behind them, got 1",
        ),
        (1, 3, "rate must be 1000 to 1000000 Hz, got 1"),
        (2**31, 3, "rate must be 1000 to 1000000 Hz, got 2147483648"),
    ],
)
def test_recording_of_other_inputs_or_rates_is_refused(
    rig: Rig, tmp_path: Path, rate: int, channels: int, words: str
) -> None:
    """Fewer channels than sensors, a second of one sample, and a rate that no converter has."""
    path, written = tmp_path / "all.wav", FILE_RATE
    noise = np.random.default_rng(0).uniform(-0.5, 0.5, (written, channels)).astype(np.float32)
    wavfile.write(path, written, noise)
    content = path.read_bytes().replace(
        written.to_bytes(4, "little"), rate.to_bytes(4, "little"), 1
    )
    path.write_bytes(content)
    with pytest.raises(InputError, match=words):
        read_stepped(path, Desk(rig, FIXED))

"""Promises of a table to accelerometers, played and measured on a plate in memory."""

import json
import threading
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from benchmarks.desk_plate.desk_plate import DeskPlate
from benchmarks.desk_plate.sensing import Converters
from benchmarks.desk_plate.truth import Actuator, Truth, draw_truth
from benchmarks.direct_plate import direct_responder
from drivers.by_hand.actions import BlockingAmplifier
from drivers.errors import CommandRefused, LinkError
from drivers.host.dialogue import StagedSet
from drivers.playing import AmplifierLayer
from era_haptics.lab.measuring import table_measurement
from era_haptics.lab.measuring.sound_card import SoundCard, read_sensors
from model.arrays import Float32Array, FloatArray
from model.cli import app
from model.errors import InputError
from model.finger import detection_threshold
from model.rig.rig import Rig, Uncertainty
from model.rig.rig_file import example_rig_path, load_rig
from model.study.promise_at_sensors import CheckSettings, Promise, promises
from model.table.table import LocalizationTable
from model.table.table_file import build_table, save_table
from model.vibration import tone_fields
from sound_cards import DeskCard

RATE = 8_000.0
LEVEL = 0.5
PLACES = {"A": (0.04, 0.05), "B": (0.20, 0.11), "C": (0.28, 0.20), "D": (0.06, 0.19)}
SENSORS = "sensor,x_m,y_m,input,mv_per_m_s2\n" + "".join(
    f"{name},{x},{y},{number},1\n" for number, (name, (x, y)) in enumerate(PLACES.items(), start=1)
)


@pytest.fixture(scope="module")
def rig() -> Rig:
    """The paper's plate, known exactly."""
    return replace(load_rig(example_rig_path()), uncertainty=Uncertainty.none())


@pytest.fixture(scope="module")
def table(rig: Rig) -> LocalizationTable:
    """Its table, of few frequencies."""
    return build_table(rig, frequencies=np.array([110.0, 170.0, 230.0]), drive_mode="phased")


class EndingCard(SoundCard):
    """A card whose only run ends in an exception that a call raises."""

    def __init__(self, end: Callable[[], None]) -> None:
        self.rate, self._end = RATE, end

    def run(self, played: FloatArray) -> Float32Array:
        """Raise it."""
        self._end()
        raise NotImplementedError

    def close(self) -> None:
        """Nothing is open."""


def as_written(rig: Rig) -> Truth:
    """The plate as its rig has it, its bases stiff up to high frequencies."""
    return replace(draw_truth(rig, seed=1), rig=rig, actuators=(Actuator(3e3, 0.7, 1.0),) * 4)


def felt_contrast(rig: Rig, promise: Promise) -> float:
    """Felt contrast [dB] at the sensors of a promise, by the direct solver."""
    points = np.array([PLACES[name] for name in promise.sensors])
    respond = direct_responder(rig.plate, rig.mesh)
    frequencies, found = tone_fields(
        promise.layer.excitation, rig.eras, lambda f: respond(rig.eras, f, points)
    )
    felt = np.linalg.norm(found / detection_threshold(frequencies)[:, None], axis=0)
    return float(20 * np.log10(felt[0] / felt[1:].max()))


def measured_on(
    truth: Truth,
    table: LocalizationTable,
    folder: Path,
    monkeypatch: pytest.MonkeyPatch,
    *more: str,
    **wires: object,
) -> tuple[int, dict[str, object]]:
    """`era table verify --device` on a plate in memory: exit status and report."""
    (folder / "sensors.csv").write_text(SENSORS)
    save_table(table, folder / "t.npz")
    sensors = read_sensors(folder / "sensors.csv", truth.rig.plate)

    def opened(_device: str, **_counts: int) -> DeskCard:
        converters = Converters(noise=5e-3)
        plate = DeskPlate(truth, sensors, rate=RATE, converters=converters, seed=1)
        return DeskCard(plate, rate=RATE, **wires)  # type: ignore[arg-type]

    monkeypatch.setattr(table_measurement, "open_card", opened)
    arguments = ["table", "verify", str(folder / "t.npz"), "--device", "memory", "--samples", "4"]
    arguments += ["--sensors", str(folder / "sensors.csv"), "--json", "--level", "0.5", *more]
    result = CliRunner().invoke(app, arguments)
    if result.exception is not None and not isinstance(result.exception, SystemExit):
        raise result.exception
    return result.exit_code, json.loads(result.stdout)


def test_promises_of_a_known_plate_are_the_direct_solution(
    rig: Rig, table: LocalizationTable
) -> None:
    """Where every parameter is exact, nine of ten plates and every other are this one."""
    for promise in promises(table, PLACES, count=3, level=LEVEL, seed=0):
        exact = min(felt_contrast(rig, promise), 25.0)  # deeper nulls show the error of the mesh
        assert min(promise.contrast_db, 25.0) == pytest.approx(exact, abs=0.5)
        assert min(promise.median_db, 25.0) == pytest.approx(exact, abs=0.5)
        strokes = rig.full_levels
        tones = promise.layer.excitation.items()
        assert max(t.amplitude / strokes[n] for n, t in tones) == pytest.approx(LEVEL)


def test_contrast_that_is_measured_is_that_of_the_plate(
    rig: Rig, table: LocalizationTable, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Played, recorded and fitted: what the direct solver says of the same patterns.

    In time damping is viscous, and the direct solver's hysteretic, which moves nulls.
    """
    _, report = measured_on(as_written(rig), table, tmp_path, monkeypatch)
    asked = list(promises(table, PLACES, count=4, level=LEVEL, seed=0))
    rows = report["promises"]
    assert isinstance(rows, list)
    assert [len(row["quiet"]) for row in rows] == [1, 2, 3, 1]
    for row, promise in zip(rows, asked, strict=True):
        exact = min(felt_contrast(rig, promise), 25.0)
        assert min(row["measured_contrast_db"], 25.0) == pytest.approx(exact, abs=1.5)
        assert row["measured_level_db_sl"] == pytest.approx(row["promised_level_db_sl"], abs=0.5)


def test_plate_that_is_another_breaks_promises(
    rig: Rig, table: LocalizationTable, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A plate built from the same drawing, not measured: exit status 1, with its picture."""
    loose = replace(rig, uncertainty=Uncertainty())
    picture = tmp_path / "p.png"
    truth = draw_truth(loose, seed=3, mesh="6x4 Q3")
    status, report = measured_on(truth, table, tmp_path, monkeypatch, "--picture", str(picture))
    assert (status, report["passed"]) == (1, False)
    assert picture.read_bytes().startswith(b"\x89PNG")


@pytest.mark.parametrize(
    ("factors", "error", "cause"),
    [
        ({3: 0.0}, LinkError, "silent: .*input 3"),
        ({3: 1e4}, InputError, "clipping of sensor C"),
        ({5: 0.0}, LinkError, r"loop-back of output 5 \(input 5\)"),
    ],
)
def test_dead_and_clipped_inputs_keep_no_promise(
    rig: Rig,
    table: LocalizationTable,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    factors: dict[int, float],
    error: type[Exception],
    cause: str,
) -> None:
    """Zeros at a quiet place would be a contrast without end, and clipping one that is too low.

    A silent loop-back cannot tell of lost blocks.
    """
    with pytest.raises(error, match=cause):
        measured_on(as_written(rig), table, tmp_path, monkeypatch, factors=factors)


@pytest.mark.parametrize(
    ("options", "said"),
    [
        (["--device", "jack"], "--sensors"),
        (["--url", "sim://"], "--device"),
        ([], "rig is missing"),
        (["--device", "memory", "--sensors", "sensors.csv", "--url", "sim://"], "rig is missing"),
        (["--device", "memory", "--sensors", "sensors.csv"], "--level"),
    ],
)
def test_options_that_say_too_little_are_refused(
    table: LocalizationTable,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    options: list[str],
    said: str,
) -> None:
    """A device without sensors; a table has no limits: an amplifier needs the rig, a card a level.

    Nothing is opened.
    """
    monkeypatch.chdir(tmp_path)
    save_table(table, Path("t.npz"))
    Path("sensors.csv").write_text(SENSORS)
    result = CliRunner().invoke(app, ["table", "verify", "t.npz", *options])
    assert isinstance(result.exception, InputError)
    assert said in str(result.exception)


@pytest.mark.parametrize(
    ("limits", "level", "key"),
    [
        ({"level": 0.2}, 0.3, "--level"),
        ({"power": 0.16}, 0.21, "--level"),  # of four ERAs, 0.2 each
        ({"on_time": 2.0}, LEVEL, "on_time"),
        ({"duty": 0.5}, LEVEL, "duty"),
        ({"slew": 15.0}, LEVEL, "slew"),
        ({"frequency_max": 100.0}, LEVEL, "frequency"),
    ],
)
def test_limits_of_the_rig_hold_for_a_card(
    rig: Rig,
    table: LocalizationTable,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    limits: dict[str, float],
    level: float,
    key: str,
) -> None:
    """No guard is behind a card: each limit is checked before a sample is played."""

    def refuse() -> None:
        raise AssertionError

    monkeypatch.setattr(
        table_measurement, "open_card", lambda _device, **_counts: EndingCard(refuse)
    )
    (tmp_path / "sensors.csv").write_text(SENSORS)
    bounded = replace(rig, limits=replace(rig.limits, **limits))
    settings = CheckSettings("memory", tmp_path / "sensors.csv", None, 1, 0, level)
    with pytest.raises(InputError, match=key):
        table_measurement.check_table(table, bounded, settings, progress=lambda _done, _count: None)


def test_no_output_exceeds_half_of_what_the_rig_allows(
    rig: Rig, table: LocalizationTable, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Nor does the loop-back's: 0.05 of a level of 0.1."""
    cards = []

    def opened(_device: str, *, limit: float, **_counts: int) -> DeskCard:
        assert limit == pytest.approx(0.05)
        plate = DeskPlate(as_written(rig), sensors, rate=RATE, converters=Converters(), seed=1)
        cards.append(DeskCard(plate, rate=RATE))
        return cards[0]

    monkeypatch.setattr(table_measurement, "open_card", opened)
    (tmp_path / "sensors.csv").write_text(SENSORS)
    sensors = read_sensors(tmp_path / "sensors.csv", rig.plate)
    bounded = replace(rig, limits=replace(rig.limits, level=0.1))
    settings = CheckSettings("memory", tmp_path / "sensors.csv", None, 1, 0, None)
    table_measurement.check_table(table, bounded, settings, progress=lambda _done, _count: None)
    assert cards[0].loudest[[cards[0].loudest.argmax(), -1]] == pytest.approx(0.05, rel=1e-3)


@pytest.mark.parametrize("trouble", [KeyboardInterrupt, LinkError])
def test_amplifier_is_disarmed_as_soon_as_the_card_ends(
    rig: Rig,
    table: LocalizationTable,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    trouble: type[BaseException],
) -> None:
    """Ctrl-C and a lost card end a vibration on its way, not four seconds later when it is over."""
    playing, ended = threading.Event(), []

    class Observed(BlockingAmplifier):
        """Notes how what it plays ends."""

        def apply(self, layers: Sequence[AmplifierLayer]) -> StagedSet:
            staged = super().apply(layers)
            playing.set()
            return staged

        def play(self, layers: Sequence[AmplifierLayer], *, duration: float) -> StagedSet:
            try:
                staged = super().play(layers, duration=duration)
            except CommandRefused:
                ended.append("disarmed")
                raise
            ended.append("played to its end")
            return staged

    def end() -> None:
        assert playing.wait(60.0)
        raise trouble

    monkeypatch.setattr(table_measurement, "BlockingAmplifier", Observed)
    monkeypatch.setattr(table_measurement, "open_card", lambda _device, **_counts: EndingCard(end))
    (tmp_path / "sensors.csv").write_text(SENSORS)
    url = f"sim://{example_rig_path()}"
    settings = CheckSettings("memory", tmp_path / "sensors.csv", url, 1, 0, LEVEL)
    with pytest.raises(trouble):
        table_measurement.check_table(table, rig, settings, progress=lambda _done, _count: None)
    assert ended == ["disarmed"]

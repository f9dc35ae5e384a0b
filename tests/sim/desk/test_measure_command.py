"""`era measure` with one sensor that is moved, as it is typed: prompts, report, and its ends."""

import json
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

from benchmarks.desk_plate.desk_plate import DeskPlate
from benchmarks.desk_plate.sensing import Converters
from benchmarks.desk_plate.truth import draw_truth
from controller.cli.main import run
from desk_card import DeskCard
from model.arrays import Float32Array, FloatArray
from model.calibration.sensor_file import read_sensors
from model.rig.file import load_rig
from sim.desk.measuring.sound_card import DeviceLost

RATE = 8_000.0
EXAMPLE = Path(__file__).parents[3] / "examples" / "desk" / "rig.yaml"
SENSORS = """sensor;x_m;y_m;input;mv_per_m_s2;mass_g
left;0,035;0,035;1;2;2
middle;0,1143;0,1143;1;2;2
right;0,2697;0,1935;1;2;2
"""
Era = Callable[..., tuple[int, str, str]]


class Card(DeskCard):
    """Its plug is pulled in the run of that number, if any."""

    pulled: int | None = None
    closed = 0

    def run(self, played: FloatArray) -> Float32Array:
        """Advance the plate, or be gone."""
        if self.runs == self.pulled:
            raise DeviceLost("memory: the device was lost, or takes no samples")
        return super().run(played)

    def close(self) -> None:
        """Count."""
        self.closed += 1


class Keys:
    """Standard input: keys in turn, then its end; the sensor is where the prompt says."""

    def __init__(self, plate: DeskPlate, names: list[str], keys: list[str]) -> None:
        self._plate, self._names, self._keys = plate, names, keys

    def readline(self) -> str:
        """Move the sensor and press a key."""
        if not self._keys:
            return ""
        key = self._keys.pop(0)
        if key == "Ctrl-C":
            raise KeyboardInterrupt
        if not key:
            self._plate.move_sensor(self._names.pop(0))
        return f"{key}\n"


@pytest.fixture
def card(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Card:
    """A plate behind a card in memory that any device name opens; its rig and sensors in files."""
    monkeypatch.chdir(tmp_path)
    Path("rig.yaml").write_text(EXAMPLE.read_text("utf-8"), "utf-8")
    Path("sensors.csv").write_text(SENSORS, "utf-8-sig")
    rig = load_rig(Path("rig.yaml"))
    sensors = read_sensors(Path("sensors.csv"), rig.plate, may_move=True)
    truth = draw_truth(rig, seed=3, mesh="6x4 Q3")
    plate = DeskPlate(truth, sensors, rate=RATE, converters=Converters(), seed=1)
    found = Card(plate, rate=RATE)
    monkeypatch.setattr("sim.desk.measuring.measure.open_card", lambda *_, **__: found)
    return found


@pytest.fixture
def era(card: Card, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> Era:
    """`era measure` with keys and the places that the sensor is put to: status, output, errors."""

    def typed(keys: list[str], names: list[str], *more: str) -> tuple[int, str, str]:
        monkeypatch.setattr(sys, "stdin", Keys(card._plate, names, keys))
        status = run(
            ["measure", "rig.yaml", "--device", "memory", "--sensors", "sensors.csv", "-o",
             "measured.uff", "--frequencies", "61:301:80", *more]
        )  # fmt: skip
        return status, *capsys.readouterr()

    return typed


def test_measurement_is_stopped_resumed_and_complete(era: Era, card: Card) -> None:
    """One place, then the end of the input; the rest with --resume, which is needed for that."""
    status, out, err = era([""], ["left"])
    assert (status, card.closed) == (0, 1)
    assert "1 of 3 places are measured, in measured.uff; go on with --resume" in out
    assert "calibrate" not in out
    assert "x 35 mm, y 35 mm (place 1 of 3)" in err
    status, _, err = era([], [])
    assert status == 2
    assert "exists; go on with --resume" in err
    status, out, _ = era(["", ""], ["middle", "right"], "--resume", "--json")
    told = json.loads(out)
    assert (status, told["places"]) == (0, {"measured": ["middle", "right"], "missing": []})
    assert told["sensors"]["right"]["coherence_min"] > 0.9
    status, out, _ = era([], [], "--resume")
    assert "Next: era calibrate rig.yaml measured.uff" in out


def test_interrupted_and_pulled_measurements_say_what_is_kept(era: Era, card: Card) -> None:
    """Ctrl-C at a place ends with its own status, a pulled card with that of a lost link."""
    status, _, err = era(["", "Ctrl-C"], ["left"])
    assert status == 130
    assert card.closed > 0
    assert err.rstrip().endswith("1 of 3 places are measured, in measured.uff; go on with --resume")
    card.pulled = card.runs + 1
    status, _, err = era([""], ["middle"], "--resume")
    assert status == 3
    assert err.splitlines()[-1].count("lost") == 1
    assert "1 of 3 places are measured" in err.splitlines()[-1]


@pytest.mark.parametrize(
    ("more", "cause"),
    [
        (["--resume"], "to go on from"),
        (["--stepped"], "--stepped needs sensors that stay"),
        (["--sensor-mass", "900"], "mass_g must be from 0"),
    ],
)
def test_options_that_do_not_fit_are_refused(era: Era, more: list[str], cause: str) -> None:
    """Nothing to resume, single tones of a moved sensor, a mass in other units."""
    status, _, err = era([], [], *more)
    assert status == 2
    assert cause in err

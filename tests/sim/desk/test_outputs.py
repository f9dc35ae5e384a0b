"""Which output drives which actuator: told by a person, and by one accelerometer."""

import json
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest
import typer
from typer.testing import CliRunner

from benchmarks.desk_plate.desk_plate import DeskPlate
from benchmarks.desk_plate.sensing import Converters
from benchmarks.desk_plate.truth import Truth
from desk_card import DeskCard
from model.arrays import Float32Array, FloatArray
from model.config.document import read_document
from model.errors import InputError
from model.rig.file import load_rig
from model.rig.rig import Rig
from sim.desk.measuring.desk import Desk
from sim.desk.measuring.outputs import Heard, listen, tone
from sim.desk.outputs_cli import outputs
from sim.sensors.sensor_file import WiredSensor

RATE = 8000.0
EXAMPLE = Path(__file__).parents[3] / "examples" / "desk" / "rig.yaml"
SENSOR = WiredSensor("A", 0.09, 0.06, 1, 0.01)  # off the lines of symmetry
MIDDLE = WiredSensor("M", 0.1524, 0.1143, 1, 0.01)


class Cabled(DeskCard):
    """Outputs wired to ERAs in another order, each with a gain; negative: wires exchanged."""

    order: Sequence[int]
    gains: Sequence[float]

    def run(self, played: FloatArray) -> Float32Array:
        """The loop-back's output is silent."""
        wired = np.zeros((len(played), 5))
        wired[:, self.order] = played * np.asarray(self.gains)
        return super().run(wired)


def cabled(
    truth: Truth,
    *,
    order: Sequence[int] = (0, 1, 2, 3),
    gains: Sequence[float] = (1, 1, 1, 1),
    sensor: WiredSensor = SENSOR,
) -> Cabled:
    """The deviating plate with one accelerometer."""
    plate = DeskPlate(truth, [sensor], rate=RATE, converters=Converters(), seed=1)
    card = Cabled(plate, rate=RATE)
    card.order, card.gains = order, gains
    return card


def heard(rig: Rig, card: Cabled, sensor: WiredSensor = SENSOR) -> list[Heard]:
    """What one sensor tells."""
    return listen(Desk(rig, (sensor,)), card, outputs=4, level=0.1)


def test_one_sensor_tells_swapped_and_backwards(rig: Rig, truth: Truth) -> None:
    """Of a plate that deviates from the rig, with an unknown delay: as it was wired here."""
    names = [era.name for era in rig.eras]
    found = heard(rig, cabled(truth, order=(0, 2, 1, 3), gains=(1, 1, -1, 1)))
    assert [each.era for each in found] == [names[n] for n in (0, 2, 1, 3)]
    assert [each.is_reversed for each in found] == [False, False, True, False]
    assert [bool(each.verdict) for each in found] == [False, False, True, False]


def test_dead_and_weak_outputs_are_said(rig: Rig, truth: Truth) -> None:
    """One plays nothing, another a quarter as loud: 12 dB, to the 3 dB that plates deviate by."""
    found = heard(rig, cabled(truth, gains=(1, 0, 1, 0.25)))
    assert [each.era for each in found] == ["SW", "", "NE", "NW"]
    assert "dead" in found[1].verdict
    assert "loose" in found[3].verdict
    assert 20 * np.log10(found[3].level) == pytest.approx(-12, abs=3)


def test_sensor_that_cannot_tell_is_refused(rig: Rig, truth: Truth) -> None:
    """In the middle all four corners of a symmetric plate are alike."""
    with pytest.raises(InputError, match="off the plate's symmetry lines"):
        heard(rig, cabled(truth, sensor=MIDDLE), MIDDLE)


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
    monkeypatch.setattr("sim.desk.measuring.sound_card.open_card", lambda *_, **__: card)
    output = tmp_path / "wired.yaml"
    app = typer.Typer()
    app.command()(outputs)
    done = CliRunner().invoke(
        app,
        [str(EXAMPLE), "--device", "jack", "-o", str(output), "--json"],
        input=said,
    )
    assert done.exit_code == status
    answer = json.loads(done.stdout.splitlines()[-1])  # what is typed is echoed before
    assert answer["channels"] == channels
    assert output.exists() == (status == 0)
    if status == 0:
        wiring = load_rig(output).wiring
        assert {name: wired.number for name, wired in wiring.items()} == channels
        after = output.read_text()
        comments = [each for each in read_document(EXAMPLE).text.splitlines() if "#" in each]
        assert all(each in after for each in comments)
    else:
        assert answer["missing"] == ["NE"]

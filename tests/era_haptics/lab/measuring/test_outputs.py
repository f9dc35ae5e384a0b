"""Outputs and their actuators, assigned by a person."""

import json
import shutil
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from era_haptics.lab.cli import app as cli_app
from era_haptics.lab.measuring.desk import Desk
from era_haptics.lab.measuring.outputs import tone
from era_haptics.lab.measuring.sensor_file import WiredSensor
from kit.desk_plate import Converters, DeskPlate, Truth
from model.arrays import Float32Array, FloatArray
from model.errors import InputError
from model.rig.rig import Rig
from model.rig.rig_file import load_rig
from tests.era_haptics.lab.measuring.card_in_memory import DeskCard

RATE = 8_000.0
EXAMPLE = Path(__file__).parents[4] / "examples" / "desk" / "rig.yaml"
SENSITIVITY = 0.01  # not known to the command


class CardWithoutLoopBack(DeskCard):
    """A card that plays on the ERAs alone."""

    def run(self, played: FloatArray) -> Float32Array:
        """Advance the plate; the output of the loop-back is silent."""
        silence = np.zeros((len(played), 1))
        return super().run(np.hstack([played, silence]))


def test_tone_is_soft_on_one_output_within_the_limits(rig: Rig) -> None:
    """Largest sample and steepest rise by hand, others silent; a forbidden frequency is refused."""
    desk = Desk(rig, ())

    samples = tone(desk, 3, outputs=4, rate=48_000, level=0.1, frequency=160.0)

    assert np.abs(samples).max() == pytest.approx(0.1, rel=1e-3)
    np.testing.assert_array_equal(samples[:, [0, 1, 3]], 0)
    steepest = np.abs(np.diff(samples, axis=0)).max()
    assert steepest < 0.1 * 2 * np.pi * 160 / 48_000 * 1.01
    assert samples[0, 2] == 0
    with pytest.raises(InputError, match="--frequency"):
        tone(desk, 1, outputs=4, rate=48_000, level=0.1, frequency=5.0)


@pytest.mark.parametrize(
    ("typed", "channels", "missing", "status"),
    [
        ("SE\nr\nsw\nxx\nNE\nNW\n", {"SE": 0, "SW": 1, "NE": 2, "NW": 3}, [], 0),
        ("SW\nSE\n-\nNW\n", {"SW": 0, "SE": 1, "NW": 3}, ["NE"], 1),
    ],
    ids=["repeated and unknown", "no output"],
)
def test_typed_channels_are_written(
    truth: Truth,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    typed: str,
    channels: dict[str, int],
    missing: list[str],
    status: int,
) -> None:
    """If all ERAs have an output; `r` repeats a tone."""
    sensors = [WiredSensor("A1", 0.1, 0.1, 1, SENSITIVITY)]
    plate = DeskPlate(truth, sensors, rate=RATE, converters=Converters(), seed=1)
    card = CardWithoutLoopBack(plate, rate=RATE)
    monkeypatch.setattr("era_haptics.lab.measuring.outputs.open_card", lambda *_, **__: card)
    rig_file, output = tmp_path / "rig.yaml", tmp_path / "wired.yaml"
    shutil.copy(EXAMPLE, rig_file)
    command = ["outputs", str(rig_file), "--device", "jack", "-o", str(output), "--json"]

    result = CliRunner().invoke(cli_app, command, input=typed)

    assert result.exit_code == status
    report = json.loads(result.stdout.splitlines()[-1])  # typed lines are echoed before
    assert report["channels"] == channels
    assert report.get("missing", []) == missing
    assert output.exists() == (not missing)
    if not missing:
        wiring = load_rig(output).wiring
        assert {name: channel.number for name, channel in wiring.items()} == channels
        assert "base: rig.yaml" in output.read_text("utf-8")

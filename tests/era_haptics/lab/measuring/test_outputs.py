"""Outputs and their actuators, assigned by a person or by one accelerometer."""

import json
import shutil
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from era_haptics.lab.cli import app as cli_app
from era_haptics.lab.measuring.desk import Desk
from era_haptics.lab.measuring.output_matching import OutputFinding, matched
from era_haptics.lab.measuring.outputs import listen_to_outputs, tone
from era_haptics.lab.measuring.sensor_file import WiredSensor
from kit.desk_plate import Converters, DeskPlate, Truth
from kit.plates import exciter_rig
from model.arrays import ComplexArray, Float32Array, FloatArray
from model.errors import InputError
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

"""Outputs and their actuators, assigned by a person or by one accelerometer."""

import json
import shutil
from collections.abc import Sequence
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
from kit.plates import as_sold, exciter_rig
from model.arrays import ComplexArray, Float32Array, FloatArray
from model.errors import InputError
from model.reduction.free_plate import solve_free_plate
from model.rig.rig import Rig
from model.rig.rig_file import load_rig
from tests.era_haptics.lab.measuring.card_in_memory import DeskCard

RATE = 8_000.0
EXAMPLE = Path(__file__).parents[4] / "examples" / "desk" / "rig.yaml"
SENSITIVITY = 0.01  # not known to the command

# By an accelerometer


class CabledCard(DeskCard):
    """A card whose outputs are wired to ERAs in another order, each with a gain.

    Negative gains are exchanged wires. Its input has an accelerometer that is moved.
    """

    order: Sequence[int]
    gains: Sequence[float]
    place = -1

    def move(self, _name: str) -> None:
        """Move the accelerometer to the next place."""
        self.place += 1

    def run(self, played: FloatArray) -> Float32Array:
        """Advance the plate; the output of the loop-back is silent."""
        wired = np.zeros((len(played), 5))
        wired[:, self.order] = played * np.asarray(self.gains)
        return super().run(wired)[:, [self.place]]


def cabled(
    truth: Truth,
    *,
    order: Sequence[int] = (0, 1, 2, 3),
    gains: Sequence[float] = (1, 1, 1, 1),
    distance: float = 0.02,
) -> CabledCard:
    """Return a card in front of the true plate, with places near the ERAs.

    distance: of each place from its ERA, towards the middle [m].
    """
    plate = truth.rig.plate
    middle = np.array([plate.length / 2, plate.width / 2])
    sensors = []
    for number, corner in enumerate(truth.rig.eras, start=1):
        position = np.array([corner.x, corner.y])
        inwards = middle - position
        x, y = position + min(distance / np.linalg.norm(inwards), 1) * inwards
        sensors.append(WiredSensor(f"A{number}", x, y, number, SENSITIVITY))
    desk_plate = DeskPlate(truth, sensors, rate=RATE, converters=Converters(), seed=1)
    card = CabledCard(desk_plate, rate=RATE)
    card.order = order
    card.gains = gains
    return card


def findings(rig: Rig, card: CabledCard) -> list[OutputFinding]:
    """Return what the accelerometer finds about each output."""
    return listen_to_outputs(Desk(rig, ()), card, 1, outputs=4, level=0.1, move=card.move)


def test_accelerometer_finds_swapped_and_backward_outputs(rig: Rig, truth: Truth) -> None:
    """On a plate that differs from the rig, with an unknown delay."""
    outputs = findings(rig, cabled(truth, order=(0, 2, 1, 3), gains=(1, 1, -1, 1)))

    assert [output.era for output in outputs] == ["SW", "NE", "SE", "NW"]
    assert [output.polarity for output in outputs] == [1, 1, -1, 1]
    assert [output.verdict == "ok" for output in outputs] == [True, True, False, True]


def test_accelerometer_finds_dead_and_weak_outputs(rig: Rig, truth: Truth) -> None:
    """An output plays nothing, another a quarter as loud: 12 dB, to the 3 dB of tolerances."""
    outputs = findings(rig, cabled(truth, gains=(1, 0, 1, 0.25)))

    assert [output.era for output in outputs] == ["SW", None, "NE", "NW"]
    assert "dead" in outputs[1].verdict
    assert "loose" in outputs[3].verdict
    assert 20 * np.log10(outputs[3].relative_level) == pytest.approx(-12, abs=3)


def test_accelerometer_must_be_moved(rig: Rig, truth: Truth) -> None:
    """In the middle, all four corners of a symmetric plate are alike."""
    with pytest.raises(InputError, match="was moved each time"):
        findings(rig, cabled(truth, distance=1.0))


def responses(rig: Rig, points: FloatArray, frequencies: FloatArray) -> ComplexArray:
    """Return the response (eras, frequencies, points) of each exciter at each place."""
    free = solve_free_plate(rig.plate, rig.mesh, frequency_max=300.0)
    fields = free.acceleration(rig.eras, frequencies, points, loads=rig.masses)
    return fields.transpose(1, 0, 2)


@pytest.mark.parametrize("seed", range(4))
def test_exciters_are_matched_on_boards_with_tolerances(seed: int) -> None:
    """Three boards: 10 % of E, 20 % of parts and gains, 10 degrees, accelerometers 25 mm off."""
    nominal = exciter_rig()
    frequencies = np.arange(81.0, 261.0, 20.0)
    points = np.array([[exciter.x, exciter.y] for exciter in nominal.eras])
    model = responses(nominal, points, frequencies)
    delay = np.exp(-2j * np.pi * frequencies * 0.0042)
    rng = np.random.default_rng(seed)
    for _ in range(3):
        board = as_sold(nominal, rng, modulus=0.1)
        angles = rng.uniform(0, 2 * np.pi, 4)
        offsets = 0.025 * np.column_stack([np.cos(angles), np.sin(angles)])
        order = rng.permutation(4)
        signs = rng.permutation([1, 1, 1, -1])
        fields = responses(board, points + offsets, frequencies)[order]
        played = signs[:, None, None] * fields * delay[:, None]

        rows, eras_of_outputs, polarities = matched(played, model, frequencies)

        assert rows.tolist() == [0, 1, 2, 3]
        assert eras_of_outputs.tolist() == order.tolist()
        assert polarities.tolist() == signs.tolist()


# By a person


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
    card = cabled(truth)
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

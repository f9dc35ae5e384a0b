"""Which side a board's grain runs along: boards of a weekend, drawn as their parts deviate."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import controller.cli.rig_cli
from benchmarks.weekend.chain import FOLDER, BuiltBoard
from controller.cli.main import run
from model.calibration.responses import Responses, write_responses
from model.diagnosis.diagnosis_report import as_json, verdict_rows
from model.diagnosis.plate_match import ShapeMatch
from model.diagnosis.verdict import check_consistency, check_meaning, diagnose
from model.errors import InputError
from model.identification.least_squares import MeasuredPlate
from model.rig.rig import Rig
from model.rig.rig_file import load_rig

TONES = np.arange(91.0, 300.0, 20.0)


def measured(rig: Rig, seed: int) -> Responses:
    """What one moved sensor reads of a board whose parts deviate, at every place or at four."""
    found = BuiltBoard.drawn(rig, seed).measured(TONES, seed)
    return found if seed % 2 else found.without(np.arange(12) % 3 > 0)


def test_shapes_that_are_alike_beyond_rounding_have_no_error() -> None:
    """A MAC of one place is 1 but for rounding, as 1 + 2.2e-16."""
    assert ShapeMatch(np.full((3, 1, 1), 1 + 2.3e-16), (0.0, 0.0)).error == 0.0


@pytest.fixture(scope="module")
def rig() -> Rig:
    """The board of the page, grain along its length."""
    return load_rig(FOLDER / "rig.yaml")


@pytest.fixture(scope="module")
def across(rig: Rig) -> Rig:
    """The same cut the other way."""
    return rig.replaced(plate={"grain": "width"})


@pytest.fixture(scope="module")
def turned(across: Rig) -> Responses:
    """Measured on a board that is cut the other way."""
    return measured(across, 1)


def test_boards_cut_as_their_file_says_are_not_accused(rig: Rig) -> None:
    """Twenty whose parts deviate as bought ones do, half of them by four of the twelve places."""
    for seed in range(20):
        check_meaning(rig, measured(rig, seed))


def test_boards_cut_the_other_way_are_accused_of_that_alone(rig: Rig, across: Rig) -> None:
    """Ten, before anything is fitted in full."""
    for seed in range(10):
        with pytest.raises(InputError, match=r"^plate\.grain must be width, got length: "):
            check_consistency(rig, measured(across, seed))


def test_the_other_side_is_named_and_wiring_is_judged_on_the_board_itself(
    across: Rig, rig: Rig
) -> None:
    """The file says width, the board has length, and two plugs are exchanged: both are said."""
    found = measured(rig, 3)
    verdict = diagnose(across, replace(found, values=found.values[:, [0, 2, 1, 3]]))
    first, second = verdict_rows(verdict)[:2]
    assert first.startswith("GRAIN: plate.grain must be length, got width: ")
    assert second.startswith("SWAPPED: channel 1 of amplifier card (ERA NW in the rig)")
    assert not verdict.is_well
    assert as_json(verdict)["plate"]["grain"]["found"] == "length"


@pytest.mark.parametrize(
    "command",
    [
        "calibrate {rig} {file} -o {made}",
        "rig identify {rig} --measured {file} -o {made}",
        "rig identify {rig} --yes -o {made}",
        "rig check {rig} --measured {file}",
    ],
)
def test_commands_say_so_and_write_no_rig(
    command: str,
    turned: Responses,
    rig: Rig,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    """By a file, and of what amplifiers would have measured."""
    here = MeasuredPlate(turned.as_measurement(), None, None, (), (), {})
    monkeypatch.setattr(controller.cli.rig_cli, "measured_by_amplifiers", lambda *_, **__: here)
    file, made = tmp_path / "measured.uff", tmp_path / "made.yaml"
    write_responses(file, turned, rig)
    typed = command.format(rig=FOLDER / "rig.yaml", file=file, made=made)
    assert run(typed.split()) != 0
    assert "plate.grain must be width, got length" in "".join(capsys.readouterr())
    assert not made.exists()

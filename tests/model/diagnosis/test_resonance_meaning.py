"""Which resonance, feet and exciters the file of a weekend's board has, and the board has not."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from benchmarks.weekend.chain import FOLDER, BuiltBoard
from controller.cli.main import run
from model.calibration.calibrate import calibrate
from model.calibration.responses import Responses, write_responses
from model.diagnosis.diagnosis_report import as_json, verdict_rows
from model.diagnosis.verdict import check_consistency, diagnose
from model.errors import InputError
from model.rig.rig import Rig
from model.rig.rig_file import load_rig

TONES = np.arange(91.0, 300.0, 20.0)
NAMES = ("NE", "NW", "SW", "SE")


def given_as(which: str, resonance: float = 306.0) -> Rig:
    """The board of the page, whose file has a resonance, by default its sheet's, as one of both."""
    keys = {"resonance": resonance, "resonance_is": which}
    return load_rig(FOLDER / "rig.yaml").replaced(eras=dict.fromkeys(NAMES, keys))


def measured(rig: Rig, seed: int) -> Responses:
    """What one moved sensor reads of a board whose parts deviate, at every place or at four."""
    found = BuiltBoard.drawn(rig, seed).measured(TONES, seed)
    return found if seed % 2 else found.without(np.arange(12) % 3 > 0)


@pytest.mark.parametrize(
    ("true", "written", "glued"), [("free", "mounted", 60), ("mounted", "free", 306)]
)
def test_the_other_resonance_is_named_before_anything_is_fitted(
    true: str, written: str, glued: int
) -> None:
    """Six boards: 306 Hz of a coil of 1.29 g are 306 sqrt(1.29 / 33.5) = 60 Hz of a magnet."""
    said = rf"^resonance_is of NE, NW, SW, SE must be {true}, got {written}: .* at {glued} Hz"
    for seed in range(6):
        with pytest.raises(InputError, match=said):
            check_consistency(given_as(written), measured(given_as(true), seed))


def test_wiring_is_judged_by_the_right_resonance() -> None:
    """Nothing is called reversed or loose, but two exchanged plugs are found."""
    found = measured(given_as("free"), 3)
    swapped = replace(found, values=found.values[:, [0, 2, 1, 3]])
    verdict = diagnose(given_as("mounted"), swapped)
    first, second, *others = verdict_rows(verdict)
    assert first.startswith("RESONANCE: resonance_is of NE, NW, SW, SE must be free, got mounted")
    assert second.startswith("SWAPPED: channel 1 of amplifier card (ERA NW in the rig)")
    assert others == []
    assert not verdict.is_well
    assert as_json(verdict)["plate"]["resonance_is"] == dict.fromkeys(NAMES, "free")


def test_a_resonance_that_differs_little_is_refused_with_what_is_at_a_bound() -> None:
    """60 Hz of the magnet, given as of its coil, are 12 Hz: from 91 Hz on both move alike."""
    found, rig = measured(given_as("free"), 1), given_as("free", 60.0)
    with pytest.raises(InputError, match=r"^stiffness of .* 10 times it.* resonance_is"):
        calibrate(rig, found, check_consistency(rig, found))


def test_feet_of_another_kind_are_refused_at_their_bound(tmp_path: Path) -> None:
    """Of foam below the board and of rubber in its file, ten times as stiff or more."""
    text = (FOLDER / "rig.yaml").read_text(encoding="utf-8")
    (tmp_path / "rig.yaml").write_text(text.replace("foam", "rubber"), encoding="utf-8")
    found, rubber = measured(given_as("free"), 1), load_rig(tmp_path / "rig.yaml")
    with pytest.raises(InputError, match=r"^stiffness of feet .* 0\.1 times it"):
        calibrate(rubber, found, check_consistency(rubber, found))


def test_a_dead_exciter_is_no_calibrated_rig(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """The file would say that it moves the plate: exit status 1, and what to type instead."""
    found, made = measured(given_as("free"), 1), tmp_path / "made.yaml"
    values = found.values.copy()
    values[:, 2] *= 1e-4
    write_responses(tmp_path / "m.uff", replace(found, values=values), given_as("free"))
    assert run(["calibrate", str(FOLDER / "rig.yaml"), f"{tmp_path}/m.uff", "-o", str(made)]) == 1
    said = "".join(capsys.readouterr())
    assert "SW did not; no rig is written. Find out why by era rig check" in said
    assert "Next:" not in said
    assert not made.exists()

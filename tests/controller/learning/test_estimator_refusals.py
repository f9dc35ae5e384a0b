"""What an estimator does with patterns that it cannot use and files of other plates."""

from pathlib import Path

import numpy as np

from controller.learning.estimator import Estimator, replies
from controller.learning.messages import Estimate, Note, Start
from model.identification.forward import Sensor
from model.identification.settled import SettledPattern
from paper_plate import make_paper_rig
from small_table import small_table


def estimator(file: Path) -> Estimator:
    """Of the paper's rig, with a sensor at each ERA."""
    rig = make_paper_rig(12, 9)
    sensors = tuple(Sensor(era.name, era.name) for era in rig.eras)
    return Estimator(Start(rig, small_table(), sensors, "switched", file))


def test_pattern_of_nothing_is_noted_and_leaves_no_file(tmp_path: Path) -> None:
    """Sensors that read 0 give a note and an estimate of no change; nothing is to be saved."""
    file = tmp_path / "learned.npz"
    found = estimator(file)
    count = len(small_table().eras)
    nothing = SettledPattern(1.0, 110.0, np.full(count, 1e-5 + 0j), np.zeros(count, dtype=complex))
    note, estimate = replies(found, nothing)
    assert isinstance(note, Note)
    assert not note.is_final
    assert isinstance(estimate, Estimate)
    assert (estimate.time, estimate.alarm, estimate.answers) == (1.0, False, None)
    assert found.save() is None
    assert not file.exists()


def test_damaged_file_is_set_aside(tmp_path: Path) -> None:
    """It is renamed, byte for byte, the note names it, and the estimator starts anew."""
    file = tmp_path / "learned.npz"
    file.write_bytes(b"something else")
    found = estimator(file)
    assert not file.exists()
    assert (tmp_path / "learned.npz.old").read_bytes() == b"something else"
    assert "learned.npz.old" in found.note
    assert found.ready().answers is None

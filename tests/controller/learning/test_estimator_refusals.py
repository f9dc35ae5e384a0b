"""What estimator and daemon do with patterns, files, answers and messages they cannot use."""

import pickle
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import cast

import numpy as np
import pytest

from controller.learning.answers_in_use import AnswersInUse
from controller.learning.estimator import Estimator
from controller.learning.messages import Answers, Estimate, Note, Start, unpacked
from controller.loop.loop import Controller
from drivers.contents import Layer, Tone
from model.errors import InputError
from model.identification.forward import Sensor
from model.identification.learned_table import LearnedTable
from model.identification.settled import SettledPattern
from model.table.table import LocalizationTable
from model.table.timing import Timing
from paper_plate import make_paper_rig
from small_table import small_table


def estimator(file: Path, *, now: Callable[[], float] = time.monotonic) -> Estimator:
    """Of the paper's rig, with a sensor at each ERA."""
    rig = make_paper_rig(12, 9)
    sensors = tuple(Sensor(era.name, era.name) for era in rig.eras)
    return Estimator(Start(rig, small_table(), sensors, "switched", file), now=now)


def test_pattern_of_nothing_is_noted_and_leaves_no_file(tmp_path: Path) -> None:
    """Sensors that read 0 give a note and an estimate of no change; nothing is to be saved."""
    file = tmp_path / "learned.npz"
    found = estimator(file)
    count = len(small_table().eras)
    nothing = SettledPattern(1.0, 110.0, np.full(count, 1e-5 + 0j), np.zeros(count, dtype=complex))
    note, estimate = found.take(nothing)
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


def test_folder_without_room_is_noted_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Attempts go on with each chore, and the next note is of another error."""
    clock, errors = [0.0], [OSError(28, "No space left on device")]

    def save(learned: LearnedTable) -> None:
        raise errors[0]

    found = estimator(tmp_path / "learned.npz", now=lambda: clock[0])
    monkeypatch.setattr(LearnedTable, "save", save)
    monkeypatch.setattr(found, "_is_saved", False)
    notes = []
    for second in range(10, 60, 10):
        clock[0] = float(second)
        if second == 40:
            errors[0] = OSError(30, "Read-only file system")
        notes.append(found.chores())
    assert [len(each) for each in notes] == [1, 0, 0, 1, 0]
    assert all(isinstance(note, Note) for each in notes for note in each)


def test_files_of_writers_that_were_killed_are_removed(tmp_path: Path) -> None:
    """Those of this file only."""
    left, other = tmp_path / ".learned.npz.0123456789ab", tmp_path / ".learned.npz.old"
    left.write_bytes(b"half")
    other.write_bytes(b"somebody's")
    estimator(tmp_path / "learned.npz")
    assert not left.exists()
    assert other.exists()


def test_answers_of_another_table_are_refused() -> None:
    """By its fingerprint, and nothing is replaced; those of the own one are, and can be reset."""
    base, taken = small_table(), list[LocalizationTable]()
    controller = SimpleNamespace(replace_answers=lambda table, timing: taken.append(table))
    in_use = AnswersInUse(cast(Controller, controller), base, Timing(base))
    other = replace(base, masses=(), eras=base.eras[::-1])
    with pytest.raises(InputError, match="table"):
        in_use.replace(Answers(other.fingerprint, other, is_complete=True))
    assert taken == []
    own = replace(base)
    in_use.replace(Answers(base.fingerprint, own, is_complete=False))
    in_use.reset()
    assert taken == [own, base]


def test_no_command_comes_by_a_message() -> None:
    """What an amplifier could play is refused, wherever it stands in it."""
    layer = Layer(0, (Tone(0, 110.0, 1.0),))
    with pytest.raises(pickle.UnpicklingError, match="drivers"):
        unpacked(pickle.dumps(Note([layer])))  # type: ignore[arg-type]

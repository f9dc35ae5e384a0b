"""A table that learns its plate: answers after a change, what is kept of it, and its refusals."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from benchmarks.identification.hidden import Hidden
from model.errors import InputError
from model.identification import learned_plate
from model.identification.learned_plate import LearnedTable, PlateEstimate
from model.rig.rig import Rig, Uncertainty
from model.table.table import LocalizationTable
from model.table.table_file import build_table
from plates import played, settled_patterns

TONES = np.array([85.0, 150.0, 215.0, 330.0])
POINTS = np.array([[0.06, 0.05], [0.15, 0.11], [0.26, 0.17], [0.22, 0.04]])


@pytest.fixture(scope="module")
def table(known: PlateEstimate) -> LocalizationTable:
    """The table of the identified rig at a few tones."""
    return build_table(known.before, frequencies=TONES, drive_mode="phased")


@pytest.mark.long
def test_answers_wait_for_an_explanation(
    hidden: Hidden, known: PlateEstimate, table: LocalizationTable
) -> None:
    """A quiet pattern gives a new table, odd ones that raise an alarm none."""
    learned = LearnedTable(table, known)
    quiet = played(learned.take, hidden, hidden.mounted, count=12)
    assert all(each.table is not None for each in quiet)
    odd = replace(hidden.mounted, stiffness=hidden.mounted.stiffness * [0.5, 1.0, 2.0, 1.0])
    first, second = played(learned.take, hidden, odd, count=2, start=12)
    assert second.report.alarm
    assert first.table is None
    assert second.table is None


@pytest.mark.long
def test_unexplained_change_widens_the_errors_of_answers(
    hidden: Hidden, known: PlateEstimate, table: LocalizationTable, tmp_path: Path
) -> None:
    """Answers then allow for the errors of a plate that was not measured, also when resumed."""
    file = tmp_path / "learned.npz"
    learned = LearnedTable(table, known, file=file)
    played(learned.take, hidden, hidden.mounted, count=12)
    odd = replace(
        hidden.mounted,
        stiffness=hidden.mounted.stiffness * [0.5, 1.0, 2.0, 1.0],
        gain=hidden.mounted.gain * [1.0, 0.5j, 1.0, 1.0],
    )
    last = played(learned.take, hidden, odd, count=7, start=12)[-1]
    assert last.report.explanation is not None
    assert last.report.explanation.resembles
    assert last.table is learned.current
    wide, built = learned.current.uncertainty, Uncertainty()
    assert (wide.gain, wide.thickness, wide.damping) == (built.gain, built.thickness, built.damping)
    learned.save()
    resumed = LearnedTable.resumed(table, known, file=file)
    assert resumed.change == learned.change != ""
    assert resumed.current.uncertainty == wide


def test_pattern_that_no_table_follows_leaves_the_state(
    hidden: Hidden, known: PlateEstimate, table: LocalizationTable, monkeypatch: pytest.MonkeyPatch
) -> None:
    """State, answers and time are those before a refused pattern, and the next one is taken."""
    learned = LearnedTable(table, known)
    first, second, third = settled_patterns(hidden, hidden.mounted, count=3)
    learned.take(first)
    state, current = learned.live.known, learned.current

    def refused(table: LocalizationTable, rig: Rig) -> LocalizationTable:
        raise InputError("thickness must be within 10 %, got 20 %")

    with monkeypatch.context() as patch:
        patch.setattr(learned_plate, "table_following", refused)
        with pytest.raises(InputError, match="thickness"):
            learned.take(second)
    assert learned.live.known is state
    assert learned.current is current
    assert learned.take(third).table is not None


def test_what_was_learned_is_resumed_for_its_table_only(
    hidden: Hidden, known: PlateEstimate, table: LocalizationTable, tmp_path: Path
) -> None:
    """The same state and answers come back; another rig's table and a damaged file are refused."""
    file = tmp_path / "learned.npz"
    learned = LearnedTable.resumed(table, known, file=file)
    played(learned.take, hidden, hidden.mounted, count=3)
    learned.live.known = replace(learned.live.known, change="a crack")
    learned.save()
    cautious = LearnedTable.resumed(table, known, file=file)
    assert cautious.change == "a crack"
    assert cautious.current.uncertainty.thickness == Uncertainty().thickness
    learned.live.known = replace(learned.live.known, change="")
    learned.save()
    again = LearnedTable.resumed(table, known, file=file)
    assert not again.change
    np.testing.assert_array_equal(
        again.live.known.state.covariance, learned.live.known.state.covariance
    )
    np.testing.assert_array_equal(
        again.current.unit_fields(POINTS), learned.current.unit_fields(POINTS)
    )
    with pytest.raises(InputError, match="this table"):
        LearnedTable.resumed(replace(table, masses=()), known, file=file)
    with pytest.raises(InputError, match="this rig"):
        LearnedTable.resumed(
            table, PlateEstimate.of_rig(known.before, known.model.sensors[:2]), file=file
        )
    content = bytearray(file.read_bytes())
    content[len(content) // 2] ^= 1
    file.write_bytes(bytes(content))
    with pytest.raises(InputError, match="remove the file"):
        LearnedTable.resumed(table, known, file=file)

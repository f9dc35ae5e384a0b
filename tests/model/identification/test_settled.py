"""A settled pattern whose phases do not count from what is played: one of them is unknown."""

from dataclasses import replace

import numpy as np
import pytest

from benchmarks.identification.hidden import draw
from model.arrays import FloatArray
from model.identification.forward import Sensor
from model.identification.in_service import Known, LivePlate
from model.identification.settled import SettledPattern, Touched
from model.rig.file import example_rig_path, load_rig
from settled_patterns import settled_patterns


@pytest.fixture(scope="module")
def known() -> Known:
    """The paper's plate by its drawing."""
    rig = load_rig(example_rig_path())
    return Known.of_rig(rig, [Sensor(era.name, era.name) for era in rig.eras])


@pytest.fixture(scope="module")
def pattern() -> SettledPattern:
    """One of another plate."""
    hidden = draw("form", 1)
    (one,) = settled_patterns(hidden, hidden.mounted, count=1, start=0)
    return one


def turned(pattern: SettledPattern, phase: float, *, has_phase: bool) -> SettledPattern:
    """The pattern, read from another moment on."""
    return replace(pattern, values=np.exp(1j * phase) * pattern.values, has_phase=has_phase)


def state_after(known: Known, pattern: SettledPattern) -> FloatArray:
    """Parameters after the pattern."""
    live = LivePlate(known)
    live.take(pattern)
    return live.state.x


def test_update_does_not_depend_on_a_phase_that_is_unknown(
    known: Known, pattern: SettledPattern
) -> None:
    """A turn of all readings together changes nothing; where their phase counts, it does."""
    before = state_after(known, turned(pattern, 0.0, has_phase=False))
    after = state_after(known, turned(pattern, 2.0, has_phase=False))
    np.testing.assert_allclose(after, before, atol=1e-9)
    counted = state_after(known, turned(pattern, 2.0, has_phase=True))
    assert np.abs(counted - before).max() > 0.1


def test_numbers_change_as_their_derivatives_say(known: Known, pattern: SettledPattern) -> None:
    """Central differences of the numbers without a phase; none lies along a common turn."""
    without = turned(pattern, 1.0, has_phase=False)
    touched = Touched.of(known.model, without, 0.5)
    x, fingers = np.zeros(known.model.space.size), np.zeros(4 * len(pattern.fingers))
    _, J = touched.predicted(x, fingers)
    step = 1e-5
    for number in known.model.space.indices("stiffness"):
        moved = x.copy()
        moved[number] = step
        ahead, _ = touched.predicted(moved, fingers)
        behind, _ = touched.predicted(-moved, fingers)
        slopes = (ahead - behind) / (2 * step)
        np.testing.assert_allclose(slopes, J[:, number], rtol=1e-3, atol=1e-7)
    turn = np.concatenate([(1j * without.values).real, (1j * without.values).imag])
    assert np.abs(turn @ J).max() < 1e-9 * np.linalg.norm(turn) * np.linalg.norm(J)

"""Promises on plates whose gains change with the level, as hysteresis changes them."""

from dataclasses import replace

import numpy as np
import pytest

from kit.plates import make_paper_rig
from model.answer.plan import query
from model.answer.stimulus import Placement
from model.rig.rig import Uncertainty
from model.study.contact_sets import random_contacts
from model.study.exact_plates import draw_plates, felt_on
from model.table.table import LocalizationTable
from model.table.table_file import build_table

IDENTIFIED = Uncertainty(0.015, 1.5, stiffness=0.01, damping=1.1, fingertip=0.5, place=0.0003)
SIZE = 0.1
"""Change of the gain over a factor of ten in level; the phase changes by 3 degrees."""


@pytest.fixture(scope="module")
def table() -> LocalizationTable:
    """Build the table of the paper's plate after an identification."""
    known = replace(IDENTIFIED, **Uncertainty.of_frequency(0.002))
    rig = replace(make_paper_rig(24, 18), uncertainty=known)
    return build_table(rig, drive_mode="phased", frequencies=np.arange(60.0, 260.0, 20.0))


def share_kept(table: LocalizationTable, level: float) -> float:
    """Share of plates with the promised contrast if answers count a change of gain with level."""
    counting = replace(table, uncertainty=replace(table.uncertainty, level=level))
    rng = np.random.default_rng(5)
    kept = []
    for _ in range(12):
        target, quiet = random_contacts(rng, 2, table.plate, margin=0.02)
        placed = Placement((target,), (quiet,))
        best = query(counting, placed, 14.0, drive_mode="phased")
        excitation = best.layers[0].excitation
        plates = draw_plates(rng, table.uncertainty, count=60, of=table, contact_count=2)
        gains = np.ones(len(table.eras), dtype=complex)
        for number, era in enumerate(table.eras):
            tone = excitation.get(era.name)
            if tone is not None:
                decades = np.log10(tone.amplitude / era.full_level)
                turn = np.exp(-1j * np.radians(3.0) * decades)
                gains[number] = (1 + SIZE * decades) * turn
        changed = replace(plates, gain=plates.gain * gains)
        _, contrast = felt_on(table, placed, excitation, changed)
        assert contrast is not None
        promised = best.fingers[0].promised_contrast_db
        kept.append(20 * np.log10(contrast) >= promised)
    return float(np.mean(kept))


def test_promises_hold_if_they_count_the_change_of_gains_with_level(
    table: LocalizationTable,
) -> None:
    """On 86 % of plates at least, and not if they ignore it."""
    assert share_kept(table, SIZE) >= 0.86 > share_kept(table, 0.0)


def test_drawn_gains_widen_with_the_change_by_level() -> None:
    """By an eighth of the change for each ERA, which add as amplitudes: a quarter for four."""
    known = replace(Uncertainty.none(), level=SIZE)

    assert known.played_gain(4) == pytest.approx(SIZE / 4)
    assert known.played_phase(4) == pytest.approx(SIZE / 8)
    assert known.gain_variance(4) == pytest.approx((SIZE / 4) ** 2 * 1.25, rel=0.01)

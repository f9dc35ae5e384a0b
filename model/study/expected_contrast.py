"""Contrasts to expect from an identified rig, and how well its promises hold on another plate."""

from dataclasses import dataclass

import numpy as np

from model.answer.plan import query
from model.answer.stimulus import MIN_LEVEL_DB_SL, Placement
from model.arrays import FloatArray
from model.ensemble.draws import PERCENTILE
from model.errors import InputError
from model.finger import decibels
from model.processes import Progress, unseen
from model.rig.rig import Rig, Uncertainty
from model.study.contact_sets import MIN_DISTANCE, random_contacts
from model.study.exact_plates import draw_plates, felt_on
from model.table.table import LocalizationTable
from model.table.table_file import build_table

_ANSWERS = 30  # on another plate: ten each with one, two and three quiet fingers
_EXPECTED_PLATES = 60
_MARGIN = 0.013  # m, of fingers from the edges


def promise_margins(rig: Rig, plate: Rig) -> tuple[float, ...]:
    """Return margins [dB] of contrasts over the promises of a rig's table, on another plate.

    For random fingers, on the exactly solved plate. Empty if the rig has no table or no room for
    four fingers.
    """
    rng, margins = np.random.default_rng(0), []
    try:
        table = build_table(rig, drive_mode="phased")
        exact_table = build_table(plate, frequencies=table.frequencies, drive_mode="phased")
        for number in range(_ANSWERS):
            margins.append(_promise_margin(table, exact_table, 2 + number % 3, rng))
    except InputError:
        return ()
    return tuple(margins)


def _promise_margin(
    table: LocalizationTable,
    exact_table: LocalizationTable,
    finger_count: int,
    rng: np.random.Generator,
) -> float:
    """Return the margin [dB] of an answer for random fingers, on the plate of another table."""
    contacts = random_contacts(rng, finger_count, table.plate)
    placed = Placement(contacts[:1], contacts[1:])
    answer = query(table, placed)
    exact_plate = draw_plates(
        rng, Uncertainty.none(), of=exact_table, count=1, contact_count=finger_count
    )
    _, contrast = felt_on(exact_table, placed, answer.layers[0].excitation, exact_plate)
    promised = answer.fingers[0].promised_contrast_db
    assert contrast is not None  # noqa: S101  there are quiet fingers
    assert promised is not None  # noqa: S101
    return float(decibels(contrast[0])) - promised


@dataclass(frozen=True)
class ExpectedContrast:
    """Contrast [dB] with a number of quiet fingers, medians over sets of contacts."""

    quiet: int
    before: float
    """Median over plates like the identified one, with answers of the rig as written."""
    after: float
    """The same with answers of the identified rig."""
    promised: float
    """Contrast that 90 % of the plates have with answers of the identified rig."""


def expected_contrast(
    before: Rig,
    after: Rig,
    *,
    seed: int,
    frequencies: FloatArray | None = None,
    sets: int = 12,
    progress: Progress = unseen,
) -> list[ExpectedContrast]:
    """Return expected contrasts for one, two and three quiet fingers; reproducible by seed.

    before, after: the rig as written and as identified, on plates within the uncertainty of the
    identified rig. frequencies (f,) [Hz]: frequencies of the tables, by default the usual ones.
    sets: number of contact sets. progress: called with the number of sets done and the total.
    """
    written = build_table(before, frequencies=frequencies, drive_mode="phased")
    identified = build_table(after, frequencies=frequencies, drive_mode="phased")
    shorter_side = min(identified.plate.length, identified.plate.width)
    expected = []
    quiet_counts = (1, 2, 3)
    total = sets * len(quiet_counts)
    for stage, quiet in enumerate(quiet_counts):
        rng = np.random.default_rng([seed, quiet])
        contrasts = []
        for number in range(sets):
            contacts = random_contacts(
                rng,
                quiet + 1,
                identified.plate,
                margin=min(_MARGIN, shorter_side / 4),
                apart=min(MIN_DISTANCE, shorter_side / (2 * (quiet + 1))),
            )
            placed = Placement(contacts[:1], contacts[1:])
            contrasts.append(_contrasts_for(written, identified, placed, rng))
            progress(stage * sets + number + 1, total)
        medians = np.median(contrasts, axis=0).tolist()
        expected.append(ExpectedContrast(quiet, *medians))
    return expected


def _contrasts_for(
    written: LocalizationTable,
    identified: LocalizationTable,
    placed: Placement,
    rng: np.random.Generator,
) -> tuple[float, float, float]:
    """Return contrasts [dB] at one set of contacts: `before`, `after`, `promised`."""
    plates = draw_plates(
        rng,
        identified.uncertainty,
        count=_EXPECTED_PLATES,
        of=identified,
        contact_count=len(placed.contacts),
    )
    contrasts = []
    for table in (written, identified):
        layer = query(table, placed, MIN_LEVEL_DB_SL).layers[0]
        _, contrast = felt_on(identified, placed, layer.excitation, plates)
        assert contrast is not None  # noqa: S101  there are quiet fingers
        contrasts.append(decibels(contrast))
    before, after = np.median(contrasts, axis=1).tolist()
    return before, after, float(np.percentile(contrasts[1], PERCENTILE))

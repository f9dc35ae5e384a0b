"""The contrast that an identified rig gives, on plates within its uncertainty solved exactly."""

from dataclasses import dataclass

import numpy as np

from model.answer.plan import query
from model.answer.stimulus import MIN_LEVEL_DB_SL, Placement
from model.arrays import FloatArray
from model.ensemble.draws import PERCENTILE
from model.identification.identify import Identification
from model.study.exact_plates import draw_plates, felt_on
from model.study.random_contacts import MIN_DISTANCE, random_contacts
from model.table.build import build_table

_PLATES = 60
_MARGIN = 0.013  # m, of fingers from the edges


@dataclass(frozen=True)
class ExpectedContrast:
    """Contrast [dB] with a number of quiet fingers, medians over sets of contacts.

    before, after: what half of the plates like the identified one give with the answers of the rig
    as written and as identified; promised: what nine of ten give with the latter.
    """

    quiet: int
    before: float
    after: float
    promised: float


def expected_contrast(
    found: Identification, *, frequencies: FloatArray | None = None, sets: int = 12
) -> list[ExpectedContrast]:
    """Expect contrasts for one, two and three quiet fingers; the same for the same seed.

    frequencies (f,) [Hz]: of the tables, by default those of any. Nothing is promised, an empty
    list, where chi² is beyond what explains a measurement or too few sensors were there.
    """
    if not found.is_explained or found.held_out is None:
        return []
    written, identified = (
        build_table(rig, frequencies=frequencies, drive_mode="phased")
        for rig in (found.before, found.rig)
    )
    expected, plate = [], identified.plate
    shorter = min(plate.length, plate.width)
    margin = min(_MARGIN, shorter / 4)
    for quiet in (1, 2, 3):
        rng = np.random.default_rng([found.seed, quiet])
        apart = min(MIN_DISTANCE, shorter / (2 * (quiet + 1)))
        rows = []
        for _ in range(sets):
            places = random_contacts(rng, quiet + 1, plate, margin=margin, apart=apart)
            placed = Placement(places[:1], places[1:])
            plates = draw_plates(
                rng,
                identified.uncertainty,
                count=_PLATES,
                of=identified,
                contact_count=quiet + 1,
            )
            each = []
            for table in (written, identified):
                drive = query(table, placed, MIN_LEVEL_DB_SL).layers[0].excitation
                contrast = felt_on(identified, placed, drive, plates).contrast
                assert contrast is not None  # noqa: S101  there are quiet fingers
                each.append(20 * np.log10(contrast))
            before, after = each
            rows.append((np.median(before), np.median(after), np.percentile(after, PERCENTILE)))
        expected.append(ExpectedContrast(quiet, *np.median(rows, axis=0).tolist()))
    return expected

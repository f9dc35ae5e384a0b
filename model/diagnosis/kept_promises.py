"""What a rig's table promises, and what of it the plate keeps that a measurement is most like.

Whatever is off, contrast tells whether it matters.
"""

from dataclasses import replace

import numpy as np

from model.answer.plan import query
from model.answer.stimulus import Placement
from model.diagnosis.verdict import Verdict
from model.errors import InputError
from model.rig.rig import Rig
from model.rig.uncertainty import Uncertainty
from model.structure.attachments import PointLoad
from model.study.exact_plates import draw_plates, felt_on
from model.study.random_contacts import random_contacts
from model.table.build import build_table

_ANSWERS = 30  # ten each with one, two and three quiet fingers


def judged_by_promises(verdict: Verdict, rig: Rig) -> Verdict:
    """The verdict with what the plate keeps of the promises to random fingers, solved exactly.

    As it is where no plate fits, and for a rig that makes no table or has no room for four fingers.
    """
    if verdict.match is None or verdict.changes is None:
        return verdict
    rng, margins = np.random.default_rng(0), []
    # The plate of a table has no finger on it.
    loads: list[object] = [*verdict.match.rig.masses]
    masses = tuple(each for each in loads if isinstance(each, PointLoad))
    plate = replace(verdict.match.rig, masses=masses)
    try:
        table = build_table(rig, drive_mode="phased")
        there = build_table(plate, frequencies=table.frequencies, drive_mode="phased")
        for number in range(_ANSWERS):
            fingers = 2 + number % 3
            places = random_contacts(rng, fingers, rig.plate)
            placed = Placement(places[:1], places[1:])
            answer = query(table, placed)
            none = Uncertainty.none()
            exact = draw_plates(rng, none, of=there, count=1, contact_count=fingers)
            felt = felt_on(there, placed, answer.layers[0].excitation, exact).contrast
            promised = answer.fingers[0].promised_contrast_db
            assert felt is not None  # noqa: S101  there are quiet fingers
            assert promised is not None  # noqa: S101
            margins.append(float(20 * np.log10(felt[0])) - promised)
    except InputError:
        return verdict
    return replace(verdict, promise_margins=tuple(margins))

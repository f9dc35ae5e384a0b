"""Felt contrast of random sets of contacts."""

from collections.abc import Callable
from itertools import islice

import numpy as np

from model.arrays import FloatArray
from model.table.many_answers import Ask, Contrasts, ask_here
from model.table.question import Question
from model.table.table import LocalizationTable
from model.table.weak_cells import are_apart

CONTACT_SETS = 64


def contrast_distribution(
    table: LocalizationTable,
    *,
    others: int,
    rng: np.random.Generator,
    ask: Ask | None = None,
    progress: Callable[[int], None] = lambda done: None,
) -> FloatArray:
    """Robust and nominal felt contrast [dB] of random contact sets, (2, up to CONTACT_SETS).

    Sets with an unreachable target are left out, and all on a plate too small for them. ask:
    answers the questions, here by default; progress: called with the number of finished sets.
    """
    size = np.array([table.plate.length, table.plate.width])
    ask = ask or ask_here(table)
    contrasts: list[Contrasts] = []
    tried = 0
    drawn = (rng.uniform(0, size, (others + 1, 2)) for _ in range(50 * CONTACT_SETS))
    apart = filter(are_apart, drawn)
    while count := min(CONTACT_SETS - len(contrasts), 2 * CONTACT_SETS - tried):
        questions = []
        for contacts in islice(apart, count):
            target, *quiet = [(float(x), float(y)) for x, y in contacts]
            questions.append(Question((target,), tuple(quiet)))
        if not questions:
            break
        tried += len(questions)
        for found in ask(questions):
            if found is not None:
                contrasts.append(found)
            progress(len(contrasts))
    return np.array(contrasts, dtype=float).reshape(-1, 2).T

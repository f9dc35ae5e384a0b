"""Questions that mirror each other have one answer."""

from dataclasses import replace

import numpy as np
import pytest

from model.structure.attachments import PointLoad
from model.table.many_answers import ask_here
from model.table.mirrored_questions import ask_once, mirror_images
from model.table.weak_cells import pair_questions
from small_table import small_table


@pytest.fixture(scope="module")
def table():
    """Of a plate that is its own mirror image along both sides."""
    return small_table()


def _questions(table):
    return [question for some in pair_questions(table) for question in some]


def test_a_quarter_of_the_questions_is_asked_on_a_symmetric_plate(table):
    """Each answer is that to the question itself, to the noise of the drawn plates."""
    questions = _questions(table)[::9]
    images = [
        replace(
            each,
            targets=tuple((table.plate.length - x, y) for x, y in each.targets),
            quiet=tuple((table.plate.length - x, y) for x, y in each.quiet),
        )
        for each in questions
    ]
    asked = []

    def ask(some):
        asked.extend(some)
        return ask_here(table)(some)

    found = np.array(list(ask_once(ask, table)(questions + images)))
    assert len(asked) <= len(questions)
    np.testing.assert_array_equal(found[: len(questions)], found[len(questions) :])
    expected = np.array(list(ask_here(table)(questions)))
    assert np.abs(found[: len(questions)] - expected)[:, 0].mean() < 0.5  # dB, drawn plates
    np.testing.assert_allclose(found[: len(questions), 1], expected[:, 1], atol=0.5)


def test_fewer_reflections_with_fewer_symmetries(table):
    """A weaker corner leaves none; a mass on the middle line, and its ERAs in pairs, leave one."""
    assert len(mirror_images(table)) == 4
    weaker = replace(table.eras[0], stroke=0.9 * table.eras[0].stroke)
    one = replace(table, eras=(weaker, *table.eras[1:]))
    assert mirror_images(one) == [(False, False)]
    mass = PointLoad(table.plate.length / 2, table.plate.width / 4, mass=0.05)
    assert mirror_images(replace(table, masses=(mass,))) == [(False, False), (True, False)]


def test_all_questions_are_asked_of_a_plate_without_symmetry(table):
    """In their order, as they are."""
    moved = replace(table.eras[0], x=table.eras[0].x + 1e-3)
    one = replace(table, eras=(moved, *table.eras[1:]))
    asked = []

    def ask(some):
        asked.extend(some)
        return iter([None] * len(some))

    questions = _questions(table)
    assert list(ask_once(ask, one)(questions)) == [None] * len(questions)
    assert asked == questions

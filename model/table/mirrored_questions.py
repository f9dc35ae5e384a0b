"""Questions that mirror each other on a symmetric plate: one answer for all of them.

The plate itself is its own mirror image along x and y. Where its ERAs and masses are too, so is all
that fingers feel, and of questions all over the plate a quarter is enough.
"""

from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import replace
from typing import TypeAlias

from model.structure.attachments import Era, PointLoad
from model.table.many_answers import Ask, Contrasts
from model.table.question import Point, Question
from model.table.table import LocalizationTable

_DECIMALS = 9  # of places [m]: below that is rounding

_Axes: TypeAlias = tuple[bool, bool]


def mirror_images(table: LocalizationTable) -> list[_Axes]:
    """The reflections, along x, along y or both, under which a table's plate is the same.

    That along neither is always one of them.
    """
    return [
        along
        for along in ((False, False), (True, False), (False, True), (True, True))
        if all(
            _placed(attached, table, along) == _placed(attached, table, (False, False))
            for attached in (table.eras, table.masses)
        )
    ]


def ask_once(ask: Ask, table: LocalizationTable) -> Ask:
    """Answers as `ask`, those of questions that mirror each other from one of them."""
    images = mirror_images(table)
    if len(images) == 1:
        return ask

    def ask_some(questions: Sequence[Question]) -> Iterator[Contrasts | None]:
        chosen = [_first_image(question, table, images) for question in questions]
        answers = ask(list(dict.fromkeys(chosen)))
        known: dict[Question, Contrasts | None] = {}
        for question in chosen:
            if question not in known:
                known[question] = next(answers)
            yield known[question]

    return ask_some


def _first_image(question: Question, table: LocalizationTable, images: Sequence[_Axes]) -> Question:
    """The image of a question that is the same for all its images."""
    count = len(question.targets)
    contacts = min(
        tuple(_reflected(at, table, along) for at in question.contacts) for along in images
    )
    return replace(question, targets=contacts[:count], quiet=contacts[count:])


def _reflected(at: Point, table: LocalizationTable, along: _Axes) -> Point:
    (x, y), plate = at, table.plate
    return (
        round(plate.length - x if along[0] else x, _DECIMALS),
        round(plate.width - y if along[1] else y, _DECIMALS),
    )


def _placed(
    attached: Iterable[Era | PointLoad], table: LocalizationTable, along: _Axes
) -> Counter[Era | PointLoad]:
    """What is attached, without names, at its reflected places."""
    found: Counter[Era | PointLoad] = Counter()
    for each in attached:
        x, y = _reflected((each.x, each.y), table, along)
        nameless = replace(each, name="") if isinstance(each, Era) else each
        found[replace(nameless, x=x, y=y)] += 1
    return found

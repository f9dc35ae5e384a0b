"""Answers to many questions in order, on several processes where there are many."""

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from typing import TypeAlias

from model.errors import InputError
from model.processes import process_pool, processor_count
from model.table.question import Question
from model.table.table import LocalizationTable

Contrasts: TypeAlias = tuple[float, float]
"""Felt contrast [dB] of nine of ten plates, and that of the plate as modelled."""

Ask: TypeAlias = Callable[[Sequence[Question]], Iterator[Contrasts | None]]
"""Answers questions with quiet fingers in order, None where the level is not reached."""

_CHUNK = 16
_MIN_WORK = 300_000
"""Questions times fields of ERAs from which on a process saves more time than its start takes."""


def ask_here(table: LocalizationTable) -> Ask:
    """Answers in this process."""

    def ask(questions: Sequence[Question]) -> Iterator[Contrasts | None]:
        return (_contrasts(table, question) for question in questions)

    return ask


@contextmanager
def ask_on_processes(
    table: LocalizationTable, *, questions: int, count: int | None = None
) -> Iterator[Ask]:
    """Answers on a number of processes, by default those that the machine has.

    questions: about how many there will be; few are answered in this process.
    """
    if count is None:
        fields = len(table.frequencies) * len(table.eras)
        count = processor_count() if questions * fields >= _MIN_WORK else 1
    if count == 1:
        yield ask_here(table)
        return
    with process_pool(count, _answers, replace(table)) as submit:

        def ask(questions: Sequence[Question]) -> Iterator[Contrasts | None]:
            starts = range(0, len(questions), _CHUNK)
            for answers in submit(questions[start : start + _CHUNK] for start in starts):
                yield from answers.result()

        yield ask


def _answers(table: LocalizationTable, questions: Sequence[Question]) -> list[Contrasts | None]:
    return [_contrasts(table, question) for question in questions]


def _contrasts(table: LocalizationTable, question: Question) -> Contrasts | None:
    try:
        found = table.query(question)
    except InputError:
        return None
    robust, nominal = found.robust_felt_contrast_db, found.felt_contrast_db
    return None if robust is None or nominal is None else (robust, nominal)

"""The estimator: settled patterns in, answers of the plate as it is known now out.

    python -m controller.learning.estimator

A process of its own, at a lower priority, so that the control loop does not wait for it. It reads
requests from standard input, answers each on standard output, and ends with its input.
"""

import contextlib
import os
import sys
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path

from controller.learning.estimator_process import (
    HEAD,
    Answers,
    Estimate,
    Note,
    Ready,
    RefreshedAnswers,
    Reply,
    Request,
    Start,
    packed,
    unpacked,
)
from controller.plate_measurement import settling
from model.answer.plan import prepare_answers
from model.errors import InputError
from model.estimate.learned_plate import LearnedTable, PlateEstimate
from model.estimate.settled_patterns import SettledPattern
from model.files.array_file import remove_partial
from model.rig.rig import Rig, Uncertainty
from model.table.table import LocalizationTable
from model.table.table_file import table_following

_NICE = 10  # above that of the daemon, whose loop comes first
_SAVE_INTERVAL, _REFRESH_INTERVAL = 10.0, 60.0  # s
_IDENTIFIED = 0.5  # of the thickness error of a plate that was not measured


class Estimator:
    """A table in service, and when it is kept and prepared whole; raises InputError.

    now: the clock of both [s].
    """

    def __init__(self, start: Start, *, now: Callable[[], float] = time.monotonic) -> None:
        self._start, self._now = start, now
        self._base = start.table.fingerprint
        self.only_alarms = why_only_alarms(start.rig)
        known = PlateEstimate.of_rig(start.rig, start.sensors)
        if self.only_alarms:
            known = replace(known, is_explained=False)
        self.note = ""
        remove_partial(start.file)
        try:
            self._learned = LearnedTable.resumed(start.table, known, file=start.file)
            if self._learned.current is not start.table:
                age = max(time.time() - start.file.stat().st_mtime, 0.0)
                live = self._learned.live
                live.known = replace(live.known, time=now() - age)
        except InputError as error:
            self.note = f"{error}; {_set_aside(start.file)}"
            self._learned = LearnedTable(start.table, known, file=start.file)
        self._saved_at = self._refreshed_at = now()
        self._is_saved = self._is_refreshed = True
        self._save_error = ""

    def ready(self) -> Ready:
        """What it starts with."""
        learned, table = self._learned, self._start.table
        low, high = float(table.frequencies[0]), float(table.frequencies[-1])
        is_resumed = learned.current is not table
        return Ready(
            settling(self._start.rig, (low, high)),
            self.note,
            self.only_alarms,
            self._prepared(learned.current, whole=True) if is_resumed else None,
            self._cautious(),
            learned.change,
        )

    def take(self, pattern: SettledPattern) -> list[Reply]:
        """Take a pattern; of one of no plate nothing is learned, and a note says so."""
        learned = self._learned
        try:
            found = learned.take(pattern)
        except ValueError as error:  # InputError and LinAlgError are such
            note = Note(f"a pattern is not used: {error}")
            return [note, Estimate(pattern.time, False, False, "", learned.change, None)]
        report, table = found.report, found.table
        if table is not None:
            self._is_saved = self._is_refreshed = False
        estimate = Estimate(
            pattern.time,
            report.alarm,
            report.is_held,
            "" if report.explanation is None else str(report.explanation),
            learned.change,
            None if table is None else self._prepared(table, whole=False),
        )
        return [estimate]

    def chores(self) -> list[Reply]:
        """Save what was learned, and prepare answers whole, where that is due."""
        now = self._now()
        note = self.save() if now >= self._saved_at + _SAVE_INTERVAL else None
        done: list[Reply] = [] if note is None else [note]
        if not self._is_refreshed and now >= self._refreshed_at + _REFRESH_INTERVAL:
            self._refreshed_at, self._is_refreshed = now, True
            whole = self._prepared(self._learned.current, whole=True)
            done.append(RefreshedAnswers(whole, self._cautious()))
        return done

    def save(self) -> Note | None:
        """Write what was learned; where that fails, say so once, and try again later."""
        self._saved_at = self._now()
        try:
            if not self._is_saved:
                self._learned.save()
        except OSError as error:
            before, self._save_error = self._save_error, str(error)
            is_new = self._save_error != before
            return Note(f"{self._start.file}: not written: {error}") if is_new else None
        self._is_saved, self._save_error = True, ""
        return None

    def _prepared(self, table: LocalizationTable, *, whole: bool) -> Answers:
        # Of its own, not the one that the next correction starts from.
        table = replace(table)
        prepare_answers(table, self._start.drive_mode)
        _ = table.in_time
        return Answers(self._base, table, whole)

    def _cautious(self) -> Answers:
        wide = table_following(self._start.table, self._learned.cautious_rig)
        return self._prepared(wide, whole=False)


def why_only_alarms(rig: Rig) -> str:
    """Why patterns may not correct answers of a rig, or nothing.

    Corrections of a plate that was never measured would put its form errors into other parameters.
    """
    stated, built = rig.uncertainty.thickness, Uncertainty().thickness
    if not stated:
        return "the rig's uncertainty takes its thickness as known exactly"
    if stated > _IDENTIFIED * built:
        return (
            f"the rig's uncertainty of thickness must be at most {100 * _IDENTIFIED * built:g} %, "
            f"that of a plate that was measured, got {100 * stated:g} %"
        )
    return ""


def _set_aside(file: Path) -> str:
    """Rename the file of another plate; what was done, or why not."""
    old = file.with_name(f"{file.name}.old")
    try:
        file.replace(old)
    except OSError as error:
        return f"it could not be renamed and will be replaced: {error}"
    return f"it is {old} now"


def _main() -> None:
    with contextlib.suppress(OSError):
        os.nice(_NICE)
    output = os.fdopen(os.dup(1), "wb")
    os.dup2(2, 1)  # for what a plugin prints
    estimator: Estimator | None = None
    try:
        for request in _requests():
            replies: list[Reply]
            if isinstance(request, Start):
                try:
                    estimator = Estimator(request)
                    replies = [estimator.ready()]
                except InputError as error:
                    replies = [Note(str(error), is_final=True)]
            else:
                assert estimator is not None  # noqa: S101  started first
                replies = estimator.chores() if request is None else estimator.take(request)
            output.write(packed(replies))
            output.flush()
    except BrokenPipeError:
        return
    finally:
        if estimator is not None:
            estimator.save()


def _requests() -> Iterator[Request]:
    """Requests until the end of the input."""
    while len(head := sys.stdin.buffer.read(HEAD)) == HEAD:
        length = int.from_bytes(head, "big")
        if len(content := sys.stdin.buffer.read(length)) == length:
            yield unpacked(content)


if __name__ == "__main__":
    _main()

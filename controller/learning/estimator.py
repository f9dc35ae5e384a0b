"""The estimator: settled patterns in, answers of the plate as it is known now out.

It works in a process of its own, at a lower priority, so that the control loop does not wait for
it. `Worker` is that process as the daemon sees it: a pool of one, whose calls have a time limit.
One that hangs can be killed at any moment, and the kernel ends it with the daemon.
"""

import asyncio
import contextlib
import os
import resource
import signal
import time
from collections.abc import Callable, Sequence
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass, replace
from multiprocessing import active_children, get_context
from pathlib import Path
from typing import Any, TypeVar

from controller.api.schema import LearningState
from controller.plate_measurement import settling
from controller.process.child import end_with_parent
from model.answer.plan import prepare_answers
from model.errors import InputError
from model.estimate.following import LearnedTable, PlateEstimate, SettledPattern
from model.estimate.forward import Sensor
from model.files.array_file import remove_partial
from model.rig.rig import Rig, Uncertainty
from model.table.table import LocalizationTable
from model.table.table_file import table_following

MAX_MEMORY = 384 << 20
"""Bytes that an estimator may take; one that needs more ends, and another starts.

With a daemon of sixteen ERAs, 0.4 GB, and its dashboard, 0.1 GB, that stays below the `MemoryMax`
of the service's unit, at which the system would end the daemon as well.
"""

_NICE = 10  # above that of the daemon, whose loop comes first
_IDENTIFIED = 0.5  # of the thickness error of a plate that was not measured
_CHANGED_REMEDY = (
    "run era rig check, and look for a loose mount, a crack or something on the plate; then "
    "identify it (era rig identify), or discard what was learned (era forget)"
)
_IDENTIFY = "identify the plate (era rig identify)"
_HELD = "the plate is not as known; the next patterns tell what has changed"
_OF_DAEMON = {signal.SIGINT, signal.SIGTERM, signal.SIGHUP, signal.SIGUSR1}
"""Signals that the daemon handles; a group or a service gets them as a whole."""

_Result = TypeVar("_Result")


@dataclass(frozen=True, eq=False)
class PlateReport:
    """The plate as the estimator knows it, after its start or a pattern."""

    state: LearningState
    cause: str
    remedy: str | None
    is_alarm: bool = False
    """Whether the pattern is not of the plate as known."""
    table: LocalizationTable | None = None
    """Corrected table, prepared for its first touch; None: answers stay as they are."""
    note: str = ""
    """A line for the log; else ""."""


class Estimator:
    """A table in service, which settled patterns correct; raises InputError.

    table: of the rig as built, never changed; sensors: those that readings come from; drive_mode:
    of the questions that answers are prepared for; file: keeps what is learned. One that is damaged
    or of another plate is renamed.
    """

    def __init__(
        self,
        rig: Rig,
        table: LocalizationTable,
        sensors: Sequence[Sensor],
        drive_mode: str,
        file: Path,
    ) -> None:
        self._rig, self._table, self._drive_mode, self._file = rig, table, drive_mode, file
        known = PlateEstimate.of_rig(rig, sensors)
        self._why_off = why_only_alarms(rig)
        known = replace(known, is_explained=not self._why_off)
        remove_partial(file)
        self._note, self._is_kept = "", True
        self._cause, self._alarms = "the plate is followed from the rig as built on", 0
        self._learned = LearnedTable(table, known, file=file)
        try:
            self._learned.resume(time.monotonic())
        except InputError as error:
            self._note = f"learning anew: {error}; {_set_aside(file)}"

    def start(self) -> tuple[float, PlateReport, LocalizationTable]:
        """The time [s] until the plate has settled, what was learned before, the cautious table."""
        found, frequencies = self._learned.current, self._table.frequencies
        if found is not self._table:
            self._cause = "the plate is followed from what was learned before on"
        report = self._report(None if found is self._table else found, note=self._note)
        rest = settling(self._rig, (float(frequencies[0]), float(frequencies[-1])))
        return rest, report, self._cautious()

    def take(self, pattern: SettledPattern) -> PlateReport:
        """Take a pattern; of one of no plate nothing is learned, and a note says so."""
        was_known = not self._learned.live.known.change and self._cause != _HELD
        try:
            found, table = self._learned.take(pattern)
        except ValueError as error:  # InputError and LinAlgError are such
            return self._report(None, note=f"a pattern is not used: {error}")
        self._is_kept = self._is_kept and table is None
        self._alarms += found.alarm
        if found.explanation is not None:
            self._cause = f"the plate has changed: {found.explanation}"
        elif found.is_held:
            self._cause = _HELD
        elif found.alarm:
            self._cause = f"the plate is not as the rig says (alarm {self._alarms})"
        elif not was_known:
            self._cause = "the plate is again as it was"
        return self._report(table, is_alarm=found.alarm)

    def keep(self) -> tuple[str, LocalizationTable | None]:
        """Write what was learned since; return why it could not be, and the cautious table of it.

        The next call tries again, with the same reason once only. None: the table is as before.
        """
        if self._is_kept:
            return "", None
        before, self._note = self._note, ""
        try:
            self._learned.save()
        except OSError as error:
            self._note = f"{self._file}: not written: {error}"
        self._is_kept = not self._note
        return "" if self._note == before else self._note, self._cautious()

    def _report(
        self, table: LocalizationTable | None, *, is_alarm: bool = False, note: str = ""
    ) -> PlateReport:
        if self._learned.live.known.change:
            said = PlateReport("changed", self._learned.live.known.change, _CHANGED_REMEDY)
        elif self._why_off:
            as_built = f"answers stay as built: {self._why_off}"
            said = PlateReport("off", self._cause if self._alarms else as_built, _IDENTIFY)
        else:
            said = PlateReport("following", self._cause, None)
        table = None if table is None else self._prepared(table)
        return replace(said, is_alarm=is_alarm, table=table, note=note)

    def _cautious(self) -> LocalizationTable:
        return self._prepared(table_following(self._table, self._learned.live.known.cautious_rig))

    def _prepared(self, table: LocalizationTable) -> LocalizationTable:
        table = replace(table)  # not the one that the next correction starts from
        prepare_answers(table, self._drive_mode)
        _ = table.in_time
        return table


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


class Worker:
    """A process that makes an object, and calls its methods one at a time.

    Nothing of it waits in this process but the caller of `call`. To be made in the main thread,
    whose end is that of the process to the kernel.
    """

    def __init__(self) -> None:
        before = {*active_children()}
        self._pool = ProcessPoolExecutor(1, get_context("spawn"), _start_process, (os.getpid(),))
        mask = signal.pthread_sigmask(signal.SIG_BLOCK, _OF_DAEMON)  # the process inherits it
        try:
            self._pool.submit(os.getpid)
        finally:
            signal.pthread_sigmask(signal.SIG_SETMASK, mask)
        (self._process,) = {*active_children()} - before
        self.pid = self._process.pid
        """Process number."""

    async def make(self, limit: float, factory: Callable[..., object], *arguments: object) -> None:
        """Make the object, within a time limit [s]; raises as `call` does."""
        await self._result(limit, _make, factory, *arguments)

    async def call(
        self, limit: float, method: Callable[..., _Result], *arguments: object
    ) -> _Result:
        """Return what a method of the object returns within a time limit [s].

        Raises what the method does, TimeoutError, and ChildProcessError where the process has died.
        """
        found: _Result = await self._result(limit, _call, method, *arguments)
        return found

    async def _result(self, limit: float, function: Callable[..., Any], *arguments: object) -> Any:
        try:
            async with asyncio.timeout(limit):
                return await asyncio.wrap_future(self._pool.submit(function, *arguments))
        except BrokenProcessPool:
            raise ChildProcessError("its process has died") from None
        except TimeoutError:
            raise TimeoutError(f"no reply within {limit:g} s") from None

    def end(self) -> None:
        """Kill the process, whatever it does."""
        self._process.kill()
        self._pool.shutdown(wait=False, cancel_futures=True)


def _start_process(parent: int) -> None:
    """Start the process of a worker."""
    end_with_parent(parent, signal.SIGKILL)
    with contextlib.suppress(OSError):
        os.nice(_NICE)
    with contextlib.suppress(ValueError):  # less is allowed already
        resource.setrlimit(resource.RLIMIT_DATA, (MAX_MEMORY, MAX_MEMORY))


_made: Any  # by the worker's factory


def _make(factory: Callable[..., object], *arguments: object) -> None:
    global _made
    _made = factory(*arguments)


def _call(method: Callable[..., _Result], *arguments: object) -> _Result:
    return method(_made, *arguments)

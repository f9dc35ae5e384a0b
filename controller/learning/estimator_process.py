"""The estimator as the daemon sees it: its messages, its process, and the answers it corrects.

A message is its length, 8 bytes, and a pickle. The estimator answers each request by one message, a
list of replies. Both sides are the same program, and no other process has their pipes.

`EstimatorProcess` hands the process one pattern at a time. Whatever happens to the process, the
daemon goes on: a process that dies, or does not answer in time, is replaced after a growing pause,
until several in a row have failed without an answer.

`AnswersInUse` replaces the answers of the control loop in one step. They were prepared before: by
the estimator, and for onsets and endings here, one frequency at a time; until then these keep the
shapes of the previous answers.
"""

import asyncio
import contextlib
import io
import logging
import os
import pickle
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeAlias

from controller.play.loop import Controller
from controller.process.child import child_command, ended
from model.answer.answer_report import Timing
from model.errors import InputError
from model.estimate.forward import Sensor
from model.estimate.settled_patterns import SettledPattern
from model.rig.rig import Rig
from model.table.table import LocalizationTable
from registry import threads
from registry.plugins import failure_text
from registry.threads import Backoff

HEAD = 8
"""Bytes of a message's length."""


@dataclass(frozen=True, eq=False)
class Start:
    """What an estimator starts from."""

    rig: Rig
    table: LocalizationTable
    """Table of the rig as built, never changed."""
    sensors: tuple[Sensor, ...]
    """Sensors that readings come from."""
    drive_mode: str
    """Drive mode of the questions that answers are prepared for."""
    file: Path
    """File of what is learned."""


@dataclass(frozen=True, eq=False)
class Answers:
    """A corrected table, prepared for its first touch."""

    base: str
    """Fingerprint of the table that it corrects."""
    table: LocalizationTable
    is_complete: bool
    """Whether onsets and endings are to be shaped anew for it, too."""


@dataclass(frozen=True, eq=False)
class Ready:
    """The estimator is ready to take patterns."""

    settling: float
    """Time [s] until the plate has settled."""
    note: str
    """Why it starts anew although there is a file; else ""."""
    only_alarms: str
    """Why it does not correct answers; else ""."""
    answers: Answers | None
    """Answers of the plate as learned before; None: of the table as built."""
    cautious: Answers
    """Answers of a plate that is not known."""
    change: str
    """How the plate had changed in a way that nothing known explains; else ""."""


@dataclass(frozen=True, eq=False)
class Estimate:
    """What a pattern has shown of the plate."""

    time: float
    """Time of the pattern [s]."""
    alarm: bool
    """Whether the plate is not as known."""
    is_held: bool
    """Whether answers wait for an explanation."""
    explanation: str
    """What has changed, if this pattern has settled it; else ""."""
    change: str
    """How the plate has changed in a way that nothing known explains; else ""."""
    answers: Answers | None
    """Corrected answers; None: they stay as they are."""


@dataclass(frozen=True, eq=False)
class RefreshedAnswers:
    """Completely prepared answers, made in idle time, and cautious ones of the same plate."""

    answers: Answers
    cautious: Answers


@dataclass(frozen=True)
class Note:
    """A line for the log."""

    text: str
    is_final: bool = False
    """Whether it says why the estimator cannot work at all."""


Request: TypeAlias = Start | SettledPattern | None
"""None: to save and prepare what is due."""

Reply: TypeAlias = Ready | Estimate | RefreshedAnswers | Note


def packed(message: Request | list[Reply]) -> bytes:
    """A message with its length."""
    content = pickle.dumps(message, protocol=5)
    return len(content).to_bytes(HEAD, "big") + content


def unpacked(content: bytes) -> Any:
    """The message of a pickle; raises pickle.UnpicklingError for what an amplifier could play."""
    return _Reader(io.BytesIO(content)).load()


class _Reader(pickle.Unpickler):
    """Makes nothing of `drivers`: commands pass the guard only as calls of it."""

    def find_class(self, module: str, name: str) -> Any:
        if module.partition(".")[0] == "drivers":
            raise pickle.UnpicklingError(f"{module}.{name} must not be in a message")
        return super().find_class(module, name)


MAX_WAITING = 16
"""Patterns that wait for the estimator; newer ones are dropped."""

_ONE_THREAD = dict.fromkeys(("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS"), "1")
_BUFFER = 1 << 22  # bytes; more than most messages have
_CHORES = 5.0  # s; after which it is to do what else is due, and so shows that it lives
_CLOSE_TIMEOUT = 0.3  # s

_logger = logging.getLogger(__name__)


@dataclass(frozen=True)
class EstimatorTimeouts:
    """How long an estimator may take [s], and how often it is replaced."""

    start: float = 60.0
    """Until it takes patterns."""
    estimate: float = 30.0
    """For one pattern; the search for an explanation takes longest."""
    max_failures: int = 8
    """Failures in a row after which it is not replaced any more."""


DEFAULT_TIMEOUTS = EstimatorTimeouts()


class EstimatorProcess:
    """An estimator that is replaced when it fails.

    start: first request to each process.
    received: called with each reply.
    failed: called when a process has ended, with the reason and whether it is the last one.
    """

    def __init__(
        self,
        start: Start,
        *,
        received: Callable[[Reply], None],
        failed: Callable[[str, bool], None],
        timeouts: EstimatorTimeouts = DEFAULT_TIMEOUTS,
    ) -> None:
        self._start, self._timeouts = start, timeouts
        self._received, self._failed = received, failed
        self._waiting: asyncio.Queue[SettledPattern] = asyncio.Queue(MAX_WAITING)
        self._has_estimated = False
        self._is_over = False
        self.pid: int | None = None
        """Of the process that runs now."""

    def hand(self, pattern: SettledPattern) -> bool:
        """Hand over a pattern; False where too many wait already, or none will be estimated."""
        if self._is_over or self._waiting.full():
            return False
        self._waiting.put_nowait(pattern)
        return True

    @property
    def waiting(self) -> int:
        """Number of patterns that wait for the estimator, without the one it is working on."""
        return 0 if self._is_over else self._waiting.qsize()

    async def run(self) -> None:
        """Keep an estimator running until cancelled, or until its failure is final."""
        timeouts, failures = self._timeouts, 0
        backoff = Backoff(first=1.0, maximum=60.0)
        while True:
            started_at, self._has_estimated = threads.now(), False
            try:
                reason = await self._run_one()
            except OSError as error:
                reason = f"cannot be started: {error}"
            failures = 1 if self._has_estimated else failures + 1
            self._is_over = self._is_over or failures >= timeouts.max_failures
            self._failed(reason, self._is_over)
            if self._is_over:
                return
            await asyncio.sleep(backoff.pause(ran_for=threads.now() - started_at))

    async def _run_one(self) -> str:
        """Run one process to its end; why it ended."""
        process = await asyncio.create_subprocess_exec(
            *child_command("controller.learning.estimator"),
            stdin=asyncio.subprocess.PIPE,
            stdout=asyncio.subprocess.PIPE,
            env={**os.environ, **_ONE_THREAD},
            limit=_BUFFER,
            start_new_session=True,  # Ctrl-C is handled by the daemon
        )
        self.pid, timeout = process.pid, 0.0
        try:
            return await self._serve(process)
        except asyncio.CancelledError:
            timeout = _CLOSE_TIMEOUT  # it keeps what it has learned
            raise
        finally:
            self.pid = None
            assert process.stdin is not None  # noqa: S101  a pipe was requested
            process.stdin.close()
            await ended(process, timeout)

    async def _serve(self, process: asyncio.subprocess.Process) -> str:
        """Hand over what waits, one after the other; why that ended."""
        request: Request = self._start
        chores_at = threads.now() + _CHORES
        while True:
            is_pattern = isinstance(request, SettledPattern)
            limit = self._timeouts.estimate if is_pattern else self._timeouts.start
            try:
                async with asyncio.timeout(limit):
                    content = await _exchange(process, packed(request))
                    if content is None:
                        return f"exited with status {await process.wait()}"
            except TimeoutError:
                return f"no reply within {limit:g} s"
            try:
                for reply in unpacked(content):
                    if isinstance(reply, Note) and reply.is_final:
                        self._is_over = True
                        return reply.text
                    self._received(reply)
            except Exception as error:
                _logger.exception("plate: a reply could not be taken")
                return f"a reply could not be taken: {failure_text(error)}"
            self._has_estimated = self._has_estimated or is_pattern
            request = None
            with contextlib.suppress(TimeoutError):
                async with asyncio.timeout(max(0.0, chores_at - threads.now())):
                    request = await self._waiting.get()
            if request is None:
                chores_at = threads.now() + _CHORES


async def _exchange(process: asyncio.subprocess.Process, request: bytes) -> bytes | None:
    """Send a request; its reply, None at the end of the output."""
    assert process.stdin is not None  # noqa: S101  pipes were requested
    assert process.stdout is not None  # noqa: S101
    process.stdin.write(request)
    try:
        head = await process.stdout.readexactly(HEAD)
        return await process.stdout.readexactly(int.from_bytes(head, "big"))
    except asyncio.IncompleteReadError:
        return None


_PAUSE = 0.02  # s; between frequencies, which take a millisecond or two each


class AnswersInUse:
    """The answers of a controller; table, timing: of the rig as built, with which it starts."""

    def __init__(self, controller: Controller, table: LocalizationTable, timing: Timing) -> None:
        self._controller = controller
        self._base = table, timing
        self.table, self._timing = table, timing

    def replace(self, answers: Answers) -> None:
        """Answer by a corrected table from now on; raises InputError for one of another table."""
        fingerprint = self._base[0].fingerprint
        if answers.base != fingerprint:
            raise InputError(f"answers must be those of table {fingerprint}, got {answers.base}")
        self._use(answers.table, self._timing.following(answers.table))

    def reset(self) -> None:
        """Answer by the table as built from now on."""
        self._use(*self._base)

    async def shape_anew(self) -> None:
        """Shape onsets and endings for the present table, while nothing is on its way."""
        timing, frequencies = Timing(self.table), self.table.frequencies.tolist()
        while frequencies:
            if not self._controller.cycle.is_preparing:
                timing.prepare([frequencies.pop()])
            await asyncio.sleep(_PAUSE)
        self._use(self.table, timing.following(self.table))

    def _use(self, table: LocalizationTable, timing: Timing) -> None:
        self.table, self._timing = table, timing
        self._controller.replace_answers(table, timing)

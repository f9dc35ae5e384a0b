"""Watch the process that plays: kill it when its sound stands still, start it anew when it ends.

A process that is stopped (a debugger, a terminal) lets the driver of the device repeat its last
block for ever; only its end gives silence.
"""

import json
import os
import select
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from contextlib import ExitStack, suppress
from dataclasses import replace
from typing import Any

from drivers.errors import LinkError
from model.errors import InputError
from sim.desk.soft_amp.__main__ import LOST
from sim.desk.soft_amp.engine import Counters, counters_in, new_file
from sim.desk.soft_amp.settings import Place, Settings

STALL = 0.1
"""Time [s] without a rendered block, after which the process that plays is killed."""

_POLL = 0.01  # s
_HELD_UP = 0.05  # s; so late, this process learns nothing of the other
_REPORT = 1.0  # s between lines on underruns
_START = 20.0  # s; the first start compiles elsewhere, and a busy machine is slow
_END = 2.0  # s
_PAUSE = 0.5  # s between starts
_PRIORITY = 2  # SCHED_RR
_BLOCKS = 4  # that a stall lasts at least

Report = Callable[[str], None]


class Supervisor:
    """Run an amplifier at a place; report: takes a line for each event.

    Events after the start go to `report`; errors of the start are raised: InputError, LinkError.
    """

    def __init__(self, settings: Settings, place: Place, *, report: Report) -> None:
        self._settings = settings
        self._place = place
        self._report = report
        self._file = new_file()
        self.counters: Counters = counters_in(self._file.fileno())
        self._stack = ExitStack()
        self._process: subprocess.Popen[bytes] | None = None
        self._rest = b""
        self._reported = 0.0
        self._seen = (0, 0)

    def start(self) -> dict[str, Any]:
        """Start to play; return what was opened: `device`, `rate` [Hz], `block` [frames]."""
        self._launch(is_recovering=False)
        end = time.monotonic() + _START
        while time.monotonic() < end:
            for event in self._events(_POLL):
                if event["event"] == "refused":
                    self.end()
                    kind = InputError if event["is_input"] else LinkError
                    raise kind(event["reason"])
                self._settings = replace(self._settings, rate=event["rate"])
                return event
            if self._status() is not None:
                break
        self.end()
        raise LinkError(f"soft-amp: {self._settings.device} was not opened in {_START:g} s")

    def watch(self, *, until: int | None) -> None:
        """Keep it playing until a descriptor has ended, or KeyboardInterrupt; None: for ever."""
        _raise_priority()
        blocks, since, looked = -1, time.monotonic(), time.monotonic()
        while True:
            for event in self._events(_POLL):
                self._report(f"{event['device']} is open again, disarmed")
            now = time.monotonic()
            if self.counters.blocks != blocks or now - looked > _HELD_UP:
                blocks, since = self.counters.blocks, now
            looked = now
            stall = max(STALL, _BLOCKS * self.counters.block / (self._settings.rate or 48_000))
            if self.counters.is_streaming and now - since > stall:
                self._kill()
                self._restart(f"no sound was made for {1e3 * (now - since):.0f} ms")
            elif (status := self._status()) is not None:
                lost = "the device was lost" if status == LOST else f"it ended with {status}"
                self._restart(lost)
            self._report_underruns(now)
            if until is not None and _has_ended(until):
                return

    def end(self) -> None:
        """Let it fall silent and end; kill it where it does not."""
        if self._process is not None:
            with suppress(ProcessLookupError):
                self._process.terminate()
            try:
                self._process.wait(_END)
            except subprocess.TimeoutExpired:
                self._kill()
        self._stack.close()

    def _launch(self, *, is_recovering: bool) -> None:
        self._stack.close()
        life, kept = os.pipe()
        self._stack.callback(os.close, kept)
        self.counters.is_streaming = self.counters.is_lost = 0
        inherited = [self._file.fileno(), self._place.terminal, self._place.listening, life]
        self._process = subprocess.Popen(  # noqa: S603  this program
            [
                *(sys.executable, "-P", "-m", "sim.desk.soft_amp"),
                self._settings.to_json(),
                *map(str, inherited),
                str(int(is_recovering)),
            ],
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            pass_fds=[number for number in inherited if number >= 0],
            start_new_session=True,  # a terminal that stops its processes leaves this one alone
        )
        os.close(life)
        assert self._process.stdout is not None  # noqa: S101  a pipe was requested
        self._stack.enter_context(self._process.stdout)
        os.set_blocking(self._process.stdout.fileno(), False)
        self._rest = b""

    def _restart(self, reason: str) -> None:
        self._report(f"silent and in fault: {reason}; opening {self._settings.device} again")
        time.sleep(_PAUSE)
        self._launch(is_recovering=True)

    def _kill(self) -> None:
        assert self._process is not None  # noqa: S101  launched before
        self._process.kill()
        self._process.wait()

    def _status(self) -> int | None:
        return None if self._process is None else self._process.poll()

    def _events(self, timeout: float) -> list[dict[str, Any]]:
        """What the process says within a time [s]."""
        assert self._process is not None  # noqa: S101  launched before
        assert self._process.stdout is not None  # noqa: S101  a pipe was requested
        if not select.select([self._process.stdout], [], [], timeout)[0]:
            return []
        data = os.read(self._process.stdout.fileno(), 65536)
        if not data:
            time.sleep(timeout)  # it ends
        *lines, self._rest = (self._rest + data).split(b"\n")
        return [json.loads(line) for line in lines]

    def _report_underruns(self, now: float) -> None:
        seen = (self.counters.gaps, self.counters.xruns)
        if seen != self._seen and now - self._reported > _REPORT:
            self._seen, self._reported = seen, now
            self._report(underruns(self.counters, rate=self._settings.rate or 48_000))


def underruns(counters: Counters, *, rate: float) -> str:
    """Underruns in words; rate [Hz]."""
    return (
        f"{counters.gaps} gaps in the sound, {counters.xruns} underruns reported by the driver, in "
        f"{counters.frames / rate:.0f} s"
    )


def _has_ended(descriptor: int) -> bool:
    return bool(select.select([descriptor], [], [], 0)[0]) and not os.read(descriptor, 4096)


def _raise_priority() -> None:
    """Watch on time, where that is allowed, beside busy processes too."""
    signal.signal(signal.SIGTSTP, signal.SIG_IGN)  # the amplifier would go on unwatched
    if hasattr(os, "sched_setscheduler"):
        policy = os.SCHED_RR | getattr(os, "SCHED_RESET_ON_FORK", 0)
        with suppress(OSError):
            os.sched_setscheduler(0, policy, os.sched_param(_PRIORITY))

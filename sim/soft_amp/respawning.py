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
from dataclasses import asdict
from typing import Any

from drivers.errors import LinkError
from model.errors import InputError
from sim.soft_amp.__main__ import LOST, OTHER_RATE
from sim.soft_amp.engine import Counters, counters_in, new_file
from sim.soft_amp.settings import SoftAmplifierLine, SoftAmplifierSettings

STALL = 0.1
"""Time [s] without a rendered block, after which the process that plays is killed."""

_POLL = 0.01  # s
_HELD_UP = 0.05  # s; so late, this process learns nothing of the other
_REPORT = 10.0  # s between lines on underruns
_START = 20.0  # s; the first start compiles elsewhere, and a busy machine is slow
_END = 2.0  # s
_PAUSE = 0.5  # s between starts
_PRIORITY = 2  # SCHED_RR
_BLOCKS = 4  # that a stall lasts at least
_ENDED = {LOST: "the device was lost", OTHER_RATE: "the device has another rate"}


class SoftAmplifierSupervisor:
    """Run an amplifier at a place; report: takes a line for each event.

    It starts at once. Events after `start` go to `report`; errors of the start are raised:
    InputError, LinkError.
    """

    def __init__(
        self,
        settings: SoftAmplifierSettings,
        place: SoftAmplifierLine,
        *,
        report: Callable[[str], None],
    ) -> None:
        self._settings = settings
        self._place = place
        self._report = report
        self._file = new_file()
        self.counters: Counters = counters_in(self._file.fileno())
        self._stack = ExitStack()
        self._reported = 0.0
        self._seen = (0, 0)
        self._said: set[str] = set()
        self._rate = 0  # Hz; of the device, or until it says its own
        self._was_open = False
        self._launch()

    def start(self) -> None:
        """Wait until it plays, or waits for a sound server."""
        end = time.monotonic() + _START
        while time.monotonic() < end:
            for event in self._events(_POLL):
                if event["event"] == "refused":
                    kind = InputError if event["is_input"] else LinkError
                    raise kind(event["reason"])
                self._take(event)
                return
            if self._process.poll() is not None:
                break
        raise LinkError(f"soft-amp: {self._settings.device} was not opened in {_START:g} s")

    def watch(self, *, until: int | None) -> None:
        """Keep it playing until a descriptor has ended, or KeyboardInterrupt; None: for ever."""
        _raise_priority()
        blocks, since, looked = -1, time.monotonic(), time.monotonic()
        while True:
            status = self._process.poll()  # before what it says, of which nothing is left then
            for event in self._events(_POLL):
                self._take(event)
            now = time.monotonic()
            if self.counters.blocks != blocks or now - looked > _HELD_UP:
                blocks, since = self.counters.blocks, now
            looked = now
            stall = max(STALL, _BLOCKS * self.counters.block / (self._rate or 48_000))
            if status is not None:
                self._restart(_ENDED.get(status, f"it ended with {status}"))
            elif self.counters.is_streaming and now - since > stall:
                self._kill()
                self._restart(f"no sound was made for {1e3 * (now - since):.0f} ms")
            self._report_underruns(now)
            said = [] if until is None else select.select([until], [], [], 0)[0]
            if said and not os.read(said[0], 4096):
                return

    def _take(self, event: dict[str, Any]) -> None:
        """Report an event of the process that plays; a reason once, until it plays again."""
        self._rate = event.get("rate", self._rate)
        if event["event"] == "ready":
            self._said.clear()
            priority = "real-time" if self.counters.is_realtime & 1 else "ordinary"
            opened = "open again, disarmed: " if self._was_open else ""
            self._was_open = True
            self._report(
                f"{opened}{event['device']}, {self._settings.channels} channels, {event['rate']} "
                f"Hz, blocks of {event['block']} frames, {priority} priority"
            )
        elif "reason" in event:
            self._say(f"silent and in fault, waiting: {event['reason']}")

    def _say(self, line: str) -> None:
        if line not in self._said:
            self._said.add(line)
            self._report(line)

    def end(self) -> None:
        """Let it fall silent and end; kill it where it does not."""
        with suppress(ProcessLookupError):
            self._process.terminate()
        try:
            self._process.wait(_END)
        except subprocess.TimeoutExpired:
            self._kill()
        self._stack.close()

    def _launch(self) -> None:
        self._stack.close()
        life, kept = os.pipe()
        self._stack.callback(os.close, kept)
        self.counters.is_streaming = self.counters.is_lost = 0
        inherited = [self._file.fileno(), self._place.terminal, self._place.listening, life]
        self._process = subprocess.Popen(  # noqa: S603  this program
            [
                sys.executable,
                "-P",
                "-m",
                "sim.soft_amp",
                json.dumps(asdict(self._settings)),
                *map(str, inherited),
                str(self._rate),
            ],
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            pass_fds=[number for number in inherited if number >= 0],
            start_new_session=True,  # a terminal that stops its processes leaves this one alone
        )
        os.close(life)
        assert self._process.stdout is not None  # noqa: S101  a pipe was requested
        self._said_by = self._stack.enter_context(self._process.stdout).fileno()
        os.set_blocking(self._said_by, False)

    def _restart(self, reason: str) -> None:
        self._say(f"silent and in fault: {reason}; opening {self._settings.device} again")
        time.sleep(_PAUSE)
        self._launch()

    def _kill(self) -> None:
        self._process.kill()
        self._process.wait()

    def _events(self, timeout: float) -> list[dict[str, Any]]:
        """What the process says within a time [s]."""
        if not select.select([self._said_by], [], [], timeout)[0]:
            return []
        data = os.read(self._said_by, 65536)  # whole lines: a pipe takes each at once
        if not data:
            time.sleep(timeout)  # it ends
        return [json.loads(line) for line in data.splitlines()]

    def _report_underruns(self, now: float) -> None:
        seen = (self.counters.gaps, self.counters.xruns)
        if seen != self._seen and now - self._reported > _REPORT:
            self._seen, self._reported = seen, now
            self._report(self.underruns())

    def underruns(self) -> str:
        """Underruns in words."""
        return (
            f"{self.counters.gaps} gaps in the sound, {self.counters.xruns} underruns reported by "
            f"the driver, in {self.counters.frames / (self._rate or 48_000):.0f} s"
        )


def _raise_priority() -> None:
    """Watch on time, where that is allowed, beside busy processes too."""
    signal.signal(signal.SIGTSTP, signal.SIG_IGN)  # the amplifier would go on unwatched
    if hasattr(os, "sched_setscheduler"):
        policy = os.SCHED_RR | getattr(os, "SCHED_RESET_ON_FORK", 0)
        with suppress(OSError):
            os.sched_setscheduler(0, policy, os.sched_param(_PRIORITY))

"""A software amplifier that plays, in the process of the command.

Its sound comes from the callback in C. The loop in this module ends the process when the device is
lost, reports gaps, and notifies systemd as long as blocks are rendered.
"""

import os
import select
import signal
import time
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

from drivers.errors import LinkError
from registry.service_manager import ServiceManager
from sim.soft_amp.engine import Counters, library, start_engine
from sim.soft_amp.output import PortAudioOutput
from sim.soft_amp.settings import SoftAmplifierLine, SoftAmplifierSettings

_POLL = 0.02  # s
_FIRST_BLOCK = 5.0  # s
_FADE = 0.05  # s; ramp, blocks and buffers
_REPORT = 10.0  # s between lines on underruns
_PRIORITY = 2  # SCHED_RR, below the sound thread's priority


def _has_ended(descriptor: int | None, *, timeout: float) -> bool:
    """Wait for a time [s]; whether a descriptor, if any, is at its end."""
    watched = [] if descriptor is None else [descriptor]
    readable, _, _ = select.select(watched, [], [], timeout)
    return bool(readable) and not os.read(readable[0], 4096)


def _raise_priority() -> None:
    """Give all threads real-time priority if that is allowed (Linux).

    A killed process stays audible until its last thread has ended, which takes half a second on a
    busy machine at ordinary priority.
    """
    priority = os.sched_param(_PRIORITY)
    for folder in Path("/proc/self/task").iterdir():
        thread = int(folder.name)
        if os.sched_getscheduler(thread) == os.SCHED_OTHER:
            os.sched_setscheduler(thread, os.SCHED_RR, priority)


class SoftAmplifierPlayer:
    """An amplifier on an open device; report: takes a line for each event.

    Raises InputError for an unsuitable device, LinkError for a busy or missing device.
    """

    def __init__(
        self,
        settings: SoftAmplifierSettings,
        line: SoftAmplifierLine,
        *,
        report: Callable[[str], None],
    ) -> None:
        self._settings = settings
        self._report = report
        self._counters = Counters()
        self._output = PortAudioOutput(settings)
        self._manager = ServiceManager()
        start_engine(settings, line, rate=self._output.rate, counters=self._counters)

    def start(self) -> None:
        """Play, from silence; returns with the first block. Raises LinkError."""
        name = self._output.name
        self._output.start()
        deadline = time.monotonic() + _FIRST_BLOCK
        while not self._counters.blocks:
            if time.monotonic() > deadline:
                raise LinkError(f"--device {name}: took no sample within {_FIRST_BLOCK:g} s")
            time.sleep(_POLL)
        with suppress(OSError, AttributeError):  # not allowed, or not Linux
            _raise_priority()
        priority = "real-time" if self._counters.is_realtime else "ordinary"
        opened = (
            f"{name}, {self._settings.channels} channels, {self._output.rate} Hz, blocks of "
            f"{self._counters.block} frames, {priority} priority"
        )
        self._report(opened)
        self._manager.ready(opened)

    def watch(self, *, until: int | None) -> None:
        """Play until a descriptor is at its end (None: never), or until KeyboardInterrupt.

        SIGTERM raises KeyboardInterrupt, and Ctrl-Z is ignored: it would stop the sound thread.
        Raises LinkError when the device is lost.
        """
        signal.signal(signal.SIGTERM, signal.default_int_handler)
        signal.signal(signal.SIGTSTP, signal.SIG_IGN)
        blocks = 0
        reported_at = time.monotonic()
        reported_losses = (0, 0)
        while True:
            if _has_ended(until, timeout=_POLL):
                return
            if not self._output.is_playing():
                self._lose()
            now = time.monotonic()
            if self._counters.blocks != blocks:
                blocks = self._counters.blocks
                self._manager.alive(now)
            losses = (self._counters.gaps, self._counters.xruns)
            if losses != reported_losses and now - reported_at > _REPORT:
                reported_at = now
                reported_losses = losses
                self._report(self.underruns())

    def _lose(self) -> None:
        library().sound_release()
        self._output.abandon()
        raise LinkError(
            f"--device {self._output.name}: the device was lost; connect it or start its sound "
            "server, then start era soft-amp again"
        )

    def underruns(self) -> str:
        """Describe the losses of sound so far."""
        seconds = self._counters.frames / self._output.rate
        return (
            f"{self._counters.gaps} gaps in the sound, {self._counters.xruns} underruns reported "
            f"by the driver, in {seconds:.0f} s"
        )

    def end(self) -> None:
        """Fall silent along a ramp, and close the device."""
        self._manager.notify("STOPPING=1")
        library().sound_end()
        time.sleep(_FADE)
        library().sound_release()
        self._output.close()
        self._manager.close()

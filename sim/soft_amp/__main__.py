"""The process that plays; `sim.soft_amp.respawning` starts, watches and, if need be, kills it.

    python -m sim.soft_amp SETTINGS COUNTERS TERMINAL LISTENING PARENT RATE

SETTINGS as JSON, then descriptors, -1 for none; RATE [Hz]: of the process that it follows, in
fault; 0 for the first one. It prints one line of JSON for each event.

Where there is no device yet, or no more, the lines are served meanwhile, in fault. One that comes
with another rate is for another process: time is counted by the rate that the lines began with.
"""

import json
import os
import signal
import sys
import time
from contextlib import suppress
from functools import partial
from types import FrameType

from drivers.errors import LinkError
from model.errors import InputError
from sim.soft_amp.engine import Counters, counters_in, library, start_engine, take_over
from sim.soft_amp.jack import NoSound
from sim.soft_amp.output import Output, open_output
from sim.soft_amp.settings import SoftAmplifierSettings

REFUSED, LOST, OTHER_RATE = 2, 75, 76
_DEFAULT_RATE = 48_000  # Hz; until the device says its own
_POLL = 0.02  # s
_RETRY = 0.5  # s
_FIRST_BLOCK = 5.0  # s
_FADE = 0.05  # s; ramp, blocks and buffers


class _EndedBySignal(Exception):
    """The process is to end, by a signal."""


def main() -> None:
    """Play until a signal comes, or the device has gone."""
    settings = SoftAmplifierSettings(**json.loads(sys.argv[1]))
    counters_file, terminal, listening, parent, rate = map(int, sys.argv[2:])
    _end_with_parent()
    signal.signal(signal.SIGTERM, _end)
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # of the terminal: that is for the parent
    counters = counters_in(counters_file)
    start = partial(
        start_engine,
        settings,
        counters=counters,
        terminal=terminal,
        listening=listening,
        parent=parent,
    )
    output: Output | None = None
    try:
        with suppress(NoSound):
            output = None if rate else open_output(settings)
        if output is not None:
            start(rate=output.rate, is_recovering=False)
        else:  # hosts are to hear of the fault before the device is there
            assumed = rate or settings.rate or _DEFAULT_RATE
            start(rate=assumed, is_recovering=True)
            output = _awaited(settings, rate=assumed)
            if output.rate != assumed:
                _tell(event="other rate", rate=output.rate)
                output.close()
                os._exit(OTHER_RATE)
        output.start()
        take_over()
        _wait_for_sound(counters, output)
        _tell(event="ready", device=output.name, rate=output.rate, block=output.block)
        while not counters.is_lost and output.is_playing():
            time.sleep(_POLL)
        library().sound_lost()  # the fault reaction
        time.sleep(_FADE)
        os._exit(LOST)  # not by way of a library whose device has gone
    except _EndedBySignal:
        library().sound_end()
        time.sleep(_FADE)
        if output is not None:
            output.close()
        os._exit(0)
    except (InputError, LinkError) as problem:
        signal.signal(signal.SIGTERM, signal.SIG_IGN)  # it ends by itself
        _tell(event="refused", is_input=isinstance(problem, InputError), reason=str(problem))
        os._exit(REFUSED)


def _awaited(settings: SoftAmplifierSettings, *, rate: int) -> Output:
    """The device, as soon as it is there, with why it is not until then; rate [Hz]: meanwhile."""
    while True:
        try:
            return open_output(settings)
        except (InputError, LinkError) as problem:
            _tell(event="waiting", rate=rate, reason=str(problem))
            time.sleep(_RETRY)


def _wait_for_sound(counters: Counters, output: Output) -> None:
    end = time.monotonic() + _FIRST_BLOCK
    while not counters.is_streaming:
        if time.monotonic() > end:
            raise LinkError(f"--device {output.name}: took no sample within {_FIRST_BLOCK:g} s")
        time.sleep(_POLL)


def _tell(**event: object) -> None:
    sys.stdout.write(json.dumps(event) + "\n")
    sys.stdout.flush()


def _end(number: int, frame: FrameType | None) -> None:
    signal.signal(signal.SIGTERM, signal.SIG_IGN)
    raise _EndedBySignal


def _end_with_parent() -> None:
    """Be killed with the process that watches, also where that is killed and this one stopped."""
    if sys.platform == "linux":
        import ctypes

        ctypes.CDLL(None).prctl(1, signal.SIGKILL)  # PR_SET_PDEATHSIG


if __name__ == "__main__":
    main()

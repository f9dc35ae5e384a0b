"""Processor time of every callback of the event loop, to find what holds it up."""

import asyncio
import gc
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Any

import pytest

MAX_CALLBACK = 0.002
"""Longest processor time [s] of a callback that handles input of clients or files."""


@dataclass
class CallbackTimes:
    """The longest callbacks so far: processor time of the loop's thread [s], and what ran."""

    longest: list[tuple[float, str]] = field(default_factory=list)

    def note(self, seconds: float, handle: asyncio.Handle) -> None:
        """Note one callback; the slowest twenty are kept."""
        if len(self.longest) < 20 or seconds > self.longest[-1][0]:
            self.longest.append((seconds, repr(handle)[:300]))
            self.longest.sort(reverse=True)
            del self.longest[20:]

    def assert_short(self, limit: float = MAX_CALLBACK) -> None:
        """Fail if any callback took longer than a limit [s]."""
        late = [(seconds, what) for seconds, what in self.longest if seconds > limit]
        assert not late, "\n".join(f"{1e3 * seconds:.1f} ms: {what}" for seconds, what in late)


@contextmanager
def measured_callbacks() -> Iterator[CallbackTimes]:
    """Measure all callbacks of event loops while the context lasts, without garbage collections.

    Time that other threads and processes take does not count.
    """
    times = CallbackTimes()
    run: Callable[[asyncio.Handle], Any] = asyncio.Handle._run

    def measured(handle: asyncio.Handle) -> None:
        begin = time.thread_time()
        run(handle)
        times.note(time.thread_time() - begin, handle)

    gc.collect()
    gc.disable()
    try:
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(asyncio.Handle, "_run", measured)
            yield times
    finally:
        gc.enable()

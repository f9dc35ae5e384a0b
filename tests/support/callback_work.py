"""Work of every callback of the event loop, to find what holds it up."""

import asyncio
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Any

import pytest

MAX_CALLS = 2000
"""Most calls of a callback that handles input of clients or files: about 1 ms."""


@dataclass
class CallbackWork:
    """The callbacks so far: how many functions each called, in Python and in C, and its name."""

    calls: list[tuple[int, str]] = field(default_factory=list)

    def assert_short(self, limit: int = MAX_CALLS) -> None:
        """Fail if any callback called more functions than a limit."""
        long = [(calls, what) for calls, what in self.calls if calls > limit]
        assert not long, "\n".join(f"{calls} calls: {what}" for calls, what in long)


@contextmanager
def counted_callbacks() -> Iterator[CallbackWork]:
    """Count the calls of all callbacks of event loops in this thread while the context lasts.

    Unlike a time they are the same on every machine.
    """
    work = CallbackWork()
    run: Callable[[asyncio.Handle], Any] = asyncio.Handle._run

    def counted(handle: asyncio.Handle) -> None:
        calls = 0

        def count(frame: object, event: str, argument: object) -> None:
            nonlocal calls
            calls += event in ("call", "c_call")

        sys.setprofile(count)
        try:
            run(handle)
        finally:
            sys.setprofile(None)
        work.calls.append((calls, repr(handle)[:300]))

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(asyncio.Handle, "_run", counted)
        yield work

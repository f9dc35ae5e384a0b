"""A bus of python-can whose `send` can hang, as that of a blocked driver."""

import contextlib
import threading
from collections.abc import Iterator
from typing import ClassVar

import can
from can.interfaces.virtual import VirtualBus


class HangingBus(VirtualBus):
    """python-can's virtual bus, whose `send` hangs while `hangs`, for ten seconds at most."""

    hangs: ClassVar[bool] = False
    resumed: ClassVar[threading.Condition] = threading.Condition()
    sending: ClassVar[int] = 0
    """Number of calls that hang now."""

    def send(self, msg: can.Message, timeout: float | None = None) -> None:
        kind = type(self)
        with kind.resumed:
            kind.sending += 1
            kind.resumed.wait_for(lambda: not kind.hangs, 10.0)
            kind.sending -= 1
        super().send(msg, timeout)

    @classmethod
    def resume(cls) -> None:
        """Let all calls go on."""
        with cls.resumed:
            cls.hangs = False
            cls.resumed.notify_all()


@contextlib.contextmanager
def hanging_interface() -> Iterator[type[HangingBus]]:
    """Make python-can know the interface `hanging`, as it would from a package."""
    can.interfaces.BACKENDS["hanging"] = (__name__, HangingBus.__name__)
    try:
        yield HangingBus
    finally:
        HangingBus.resume()
        del can.interfaces.BACKENDS["hanging"]

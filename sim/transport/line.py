"""A simulated wire: how long telegrams take on it each way, and what befalls them.

Not modelled: the gaps between the bytes of one telegram; it arrives whole, when its last bit would.
"""

import asyncio
from collections.abc import Callable
from functools import partial

from drivers import clock
from sim.faults.fault_window import Faults, Toward


class Line:
    """One direction. Carries telegrams one way, in the running event loop.

    deliver is called with each that arrives; bits_per_second: of the wire, None for one that takes
    no time; bits_per_byte: on it, framing included.
    """

    def __init__(
        self,
        deliver: Callable[[bytes], None],
        *,
        toward: Toward,
        faults: Faults,
        bits_per_second: float | None = None,
        bits_per_byte: float = 10.0,
    ) -> None:
        self._deliver = deliver
        self._toward = toward
        self._faults = faults
        self._byte_time = bits_per_byte / bits_per_second if bits_per_second else 0.0
        self._free_from = 0.0
        self._on_the_way: set[asyncio.TimerHandle] = set()

    def send(self, telegram: bytes) -> None:
        """Put a telegram on the wire; it waits for those before it."""
        now = clock.now()
        arriving = self._faults.pass_on(telegram, toward=self._toward, time=now)
        for delay, data in arriving:
            self._free_from = max(now, self._free_from) + len(data) * self._byte_time
            due = self._free_from + delay
            if due <= now and not self._on_the_way:
                self._deliver(data)
            else:
                self._deliver_later(due - now, data)

    def close(self) -> None:
        """What is on the way is lost."""
        for timer in self._on_the_way:
            timer.cancel()
        self._on_the_way.clear()

    def _deliver_later(self, delay: float, data: bytes) -> None:
        def arrive() -> None:
            self._on_the_way.discard(timer)
            self._deliver(data)

        timer = asyncio.get_running_loop().call_later(delay, arrive)
        self._on_the_way.add(timer)


class TwoWayLine:
    """A wire: `inward` carries to the amplifier, `outward` to the host; the rest as for `Line`."""

    def __init__(
        self,
        *,
        to_amplifier: Callable[[bytes], None],
        to_host: Callable[[bytes], None],
        faults: Faults,
        bits_per_second: float | None = None,
        bits_per_byte: float = 10.0,
    ) -> None:
        make = partial(
            Line, faults=faults, bits_per_second=bits_per_second, bits_per_byte=bits_per_byte
        )
        self.inward = make(to_amplifier, toward="amplifier")
        self.outward = make(to_host, toward="host")

    def close(self) -> None:
        """What is on the way is lost."""
        self.inward.close()
        self.outward.close()

"""A simulated wire: transmission time and injected faults.

Not modelled: gaps between the bytes of a frame; it arrives at once, at the time of its last bit.
"""

import asyncio
from collections.abc import Callable
from functools import partial

from drivers import clock
from sim.faults.fault_window import Faults, Toward


class Line:
    """One direction of a wire, in the running event loop.

    deliver: called with each frame that arrives; bits_per_second: None for no transmission time;
    bits_per_byte: framing included; finds_damage: see `Faults.pass_on`.
    """

    def __init__(
        self,
        deliver: Callable[[bytes], None],
        *,
        toward: Toward,
        faults: Faults,
        bits_per_second: float | None = None,
        bits_per_byte: float = 10.0,
        finds_damage: bool = False,
    ) -> None:
        self._deliver = deliver
        self._finds_damage = finds_damage
        self._toward = toward
        self._faults = faults
        self._byte_time = bits_per_byte / bits_per_second if bits_per_second else 0.0
        self._free_from = 0.0
        self._in_flight: set[asyncio.TimerHandle] = set()

    def send(self, frame: bytes) -> None:
        """Send a frame; it queues behind earlier ones."""
        now = clock.now()
        arriving = self._faults.pass_on(
            frame, toward=self._toward, time=now, finds_damage=self._finds_damage
        )
        for delay, data in arriving:
            self._free_from = max(now, self._free_from) + len(data) * self._byte_time
            due = self._free_from + delay
            if due <= now and not self._in_flight:
                self._deliver(data)
            else:
                self._deliver_later(due - now, data)

    def close(self) -> None:
        """Discard the frames in flight."""
        for timer in self._in_flight:
            timer.cancel()
        self._in_flight.clear()

    def _deliver_later(self, delay: float, data: bytes) -> None:
        def arrive() -> None:
            self._in_flight.discard(timer)
            self._deliver(data)

        timer = asyncio.get_running_loop().call_later(delay, arrive)
        self._in_flight.add(timer)


class TwoWayLine:
    """Both directions: `inward` to the amplifier, `outward` to the host; see `Line`."""

    def __init__(
        self,
        *,
        to_amplifier: Callable[[bytes], None],
        to_host: Callable[[bytes], None],
        faults: Faults,
        bits_per_second: float | None = None,
        bits_per_byte: float = 10.0,
        finds_damage: bool = False,
    ) -> None:
        make = partial(
            Line,
            faults=faults,
            bits_per_second=bits_per_second,
            bits_per_byte=bits_per_byte,
            finds_damage=finds_damage,
        )
        self.inward = make(to_amplifier, toward="amplifier")
        self.outward = make(to_host, toward="host")

    def close(self) -> None:
        """Discard the frames in flight."""
        self.inward.close()
        self.outward.close()

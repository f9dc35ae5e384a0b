"""A simulated wire: transmission time, the delays of its kind of line, and injected faults.

What takes long arrives in pieces, each at the time of its last bit, so that an amplifier that minds
pauses between bytes sees none. Not modelled: gaps between the bytes of a frame.
"""

import asyncio
from collections.abc import Callable
from functools import partial

from registry import threads
from sim.faults import Faults, Toward
from sim.transport.line_kinds import LineDelays

_PIECE = 0.01  # s; of the wire's time, of what arrives at once


class Line:
    """One direction of a wire, in the running event loop.

    deliver: called with each frame that arrives, and when [s]; delays: None for none;
    byte_time: of each byte on the wire [s]; finds_damage: see `Faults.pass_on`.
    """

    def __init__(
        self,
        deliver: Callable[[bytes, float], None],
        *,
        toward: Toward,
        faults: Faults,
        delays: LineDelays | None = None,
        byte_time: float = 0.0,
        finds_damage: bool = False,
    ) -> None:
        self._deliver = deliver
        self._delays = delays
        self._finds_damage = finds_damage
        self._toward = toward
        self._faults = faults
        self._byte_time = byte_time
        self._free_from = 0.0
        self._in_flight: set[asyncio.TimerHandle] = set()

    def send(self, frame: bytes, now: float | None = None) -> None:
        """Send a frame, which queues behind earlier ones; now: the present time [s] if not given.

        The same time for several lines makes what they carry arrive at one time.
        """
        now = threads.now() if now is None else now
        arriving = self._faults.pass_on(
            frame, toward=self._toward, time=now, finds_damage=self._finds_damage
        )
        for delay, data in arriving:
            leaves = now
            if self._delays is not None and self._toward == "amplifier":
                leaves = self._delays.leave(now, len(data))
            size = max(int(_PIECE / self._byte_time), 1) if self._byte_time else max(len(data), 1)
            for at in range(0, max(len(data), 1), size):  # no bytes: the end of a connection
                piece = data[at : at + size]
                self._free_from = max(leaves, self._free_from) + len(piece) * self._byte_time
                arrives = self._free_from
                if self._delays is not None and self._toward == "host":
                    arrives = self._delays.arrive(arrives, len(piece))
                due = arrives + delay
                if due <= now and not self._in_flight:
                    self._deliver(piece, now)
                else:
                    self._deliver_later(due - now, piece)

    def close(self) -> None:
        """Discard the frames in flight."""
        for timer in self._in_flight:
            timer.cancel()
        self._in_flight.clear()

    def _deliver_later(self, delay: float, data: bytes) -> None:
        def arrive() -> None:
            self._in_flight.discard(timer)
            self._deliver(data, threads.now())

        timer = asyncio.get_running_loop().call_later(delay, arrive)
        self._in_flight.add(timer)


class TwoWayLine:
    """Both directions: `inward` to the amplifier, `outward` to the host; see `Line`.

    to_amplifier: called with frames and times [s]; to_host: with frames; delays: None for none.
    """

    def __init__(
        self,
        *,
        to_amplifier: Callable[[bytes, float], None],
        to_host: Callable[[bytes], None],
        faults: Faults,
        delays: LineDelays | None = None,
        byte_time: float = 0.0,
        finds_damage: bool = False,
    ) -> None:
        make = partial(
            Line,
            faults=faults,
            delays=delays,
            byte_time=byte_time,
            finds_damage=finds_damage,
        )
        self.inward = make(to_amplifier, toward="amplifier")
        self.outward = make(lambda data, now: to_host(data), toward="host")

    def close(self) -> None:
        """Discard the frames in flight."""
        self.inward.close()
        self.outward.close()

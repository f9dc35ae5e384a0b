"""A simulated line: transmission time, the delays of its kind, and injected faults.

Delays come from operating systems, USB frames, latency timers and networks. Long transmissions
arrive in pieces, each at the time of its last bit, so that an amplifier sensitive to pauses between
bytes detects none. Not modeled: gaps between the bytes of a frame, retransmission, other devices
on the same USB, the trigger levels of UARTs, an FTDI packet that a second reply fills up.
"""

import asyncio
import math
import random
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import partial

from registry import threads
from sim.faults import Faults, Toward

_FTDI_PACKET = 62  # bytes, in addition to two status bytes
_MAX_SIGMAS = 4.0  # limit of the log-normal part
_MAX_STALL = 5.0  # limit of a stall, in mean stalls
_ORDER = 1e-9  # s; between arrivals, because simultaneous timers run in arbitrary order
_FRAME_ERROR = 50e-6  # of a USB host's crystal relative to its machine's clock; up to 500e-6


@dataclass(frozen=True)
class Latency:
    """Time that programs and drivers take [s]: `least`, a log-normal part, and seldom a stall.

    median, sigma: of the log-normal part; stalls: share with an exponential stall; stall: its mean
    [s], of which it takes five times at most.
    """

    least: float = 0.0
    median: float = 0.0
    sigma: float = 0.0
    stalls: float = 0.0
    stall: float = 0.0

    def draw(self, rng: random.Random) -> float:
        """Draw one [s]."""
        deviation = max(min(rng.gauss(0.0, 1.0), _MAX_SIGMAS), -_MAX_SIGMAS)
        typical = self.least + self.median * math.exp(self.sigma * deviation)
        if rng.random() < self.stalls:
            return typical + min(rng.expovariate(1 / self.stall), _MAX_STALL * self.stall)
        return typical

    @property
    def max_delay(self) -> float:
        """The longest one [s]."""
        without_stall = self.least + self.median * math.exp(_MAX_SIGMAS * self.sigma)
        if not self.stalls:
            return without_stall
        return without_stall + _MAX_STALL * self.stall


@dataclass(frozen=True)
class LineKind:
    """A kind of line between a host and amplifiers.

    writing: from a host's call until its bytes leave the machine; waking: from their arrival until
    the host's program has them; frame [s]: of USB, in which what is ready goes with the start of
    the next (USB 2.0, 4.4: 1 ms at full speed, 125 us at high speed), 0 without; usb_byte: of a
    byte on USB [s]; latency_timer [s]: of an FTDI chip, 0 without.
    """

    writing: Latency
    waking: Latency
    frame: float = 0.0
    usb_byte: float = 0.0
    latency_timer: float = 0.0

    @property
    def max_delay(self) -> float:
        """The longest delay of a few bytes there and back together [s]."""
        programs = self.writing.max_delay + self.waking.max_delay
        return programs + 2 * self.frame * (1 + _FRAME_ERROR) + self.latency_timer

    def delays(self, seed: object) -> "LineDelays":
        """Return the delays of a line; equal seeds give equal delays."""
        return LineDelays(self, random.Random(repr(seed)))  # noqa: S311  reproducible, not secret


class LineDelays:
    """Delays of a line of a kind; times must be in the order of the bytes, in each direction."""

    def __init__(self, kind: LineKind, rng: random.Random) -> None:
        self._kind = kind
        self._rng = rng
        self._frame = kind.frame * (1 + rng.uniform(-_FRAME_ERROR, _FRAME_ERROR))
        self._first_frame = rng.uniform(0.0, kind.frame)
        # Times [s] of the last bytes in each direction.
        self._left = -math.inf
        self._arrived = -math.inf
        self._packet_sent = rng.uniform(0.0, kind.latency_timer)  # of an FTDI chip, to the host
        self._held = 0  # bytes in that chip

    def leave(self, time: float, size: int) -> float:
        """Return when so many bytes that a host writes at a time begin on the line [s]."""
        ready = self._next_frame(time + self._kind.writing.draw(self._rng))
        self._left = max(self._left + _ORDER, ready + size * self._kind.usb_byte)
        return self._left

    def arrive(self, time: float, size: int) -> float:
        """Return the arrival time [s] of bytes whose last bit leaves the line at a time."""
        ready = self._next_frame(self._packet_end(time, size)) + size * self._kind.usb_byte
        self._arrived = max(self._arrived + _ORDER, ready + self._kind.waking.draw(self._rng))
        return self._arrived

    def _next_frame(self, time: float) -> float:
        if not self._frame:
            return time
        frames = math.ceil((time - self._first_frame) / self._frame)
        return self._first_frame + frames * self._frame

    def _packet_end(self, time: float, size: int) -> float:
        """Return when an FTDI chip lets the last byte go [s].

        It sends full packets. When the timer has run since the last packet it sends the bytes that
        it holds, or its status alone (AN232B-04, *Small amounts of data and end of buffer
        conditions*).
        """
        timer = self._kind.latency_timer
        if not timer:
            return time
        expired = math.floor((time - self._packet_sent) / timer)
        if expired > 0:
            self._packet_sent += expired * timer
            self._held = 0
        packets, self._held = divmod(self._held + size, _FTDI_PACKET)
        if packets:
            self._packet_sent = time
        return self._packet_sent + timer if self._held else time


# A machine with three processes per processor, measured on a pseudo-terminal: the median wake-up
# takes 81 us, the 10th percentile is 42 us, and 1 % take more than a millisecond.
_WRITING = Latency(least=8e-6, median=5e-6, sigma=0.8, stalls=0.005, stall=1e-3)
_WAKING = Latency(least=20e-6, median=55e-6, sigma=0.6, stalls=0.02, stall=1e-3)
# Includes the network stacks of both ends, and the amplifier's task waiting for its processor.
_SENDING = Latency(least=60e-6, median=50e-6, sigma=1.0, stalls=0.02, stall=2e-3)
_RECEIVING = Latency(least=80e-6, median=90e-6, sigma=1.0, stalls=0.03, stall=2e-3)
_HIGH_SPEED = LineKind(_WRITING, _WAKING, frame=125e-6, usb_byte=8 / 480e6)
_FULL_SPEED = LineKind(_WRITING, _WAKING, frame=1e-3, usb_byte=8 / 12e6)

PROMPT = "prompt"
"""The name of a line that adds nothing."""
LINE_KINDS: Mapping[str, LineKind] = {
    "native": LineKind(_WRITING, _WAKING),
    "usb-high-speed": _HIGH_SPEED,
    "usb-full-speed": _FULL_SPEED,
    "ftdi": replace(_FULL_SPEED, latency_timer=16e-3),
    "ftdi-low-latency": replace(_FULL_SPEED, latency_timer=1e-3),
    "can": LineKind(_WRITING, _WAKING),
    "can-usb": _FULL_SPEED,
    "ethernet": LineKind(_SENDING, _RECEIVING),
}
"""Kinds of lines by name, except `PROMPT`.

native: a UART of the board; ftdi: with the chip's timer of 16 ms, or as set by the host's driver,
if possible; can: a controller of the board, can-usb: an adapter; ethernet: Modbus TCP, servers.
On CAN a frame also waits for the frame on the bus.
"""
LINE_NAMES = (*LINE_KINDS, PROMPT)
"""All kinds of lines."""


def delays_of(kind: str | None, *line: object) -> LineDelays | None:
    """Return the delays of a line by kind; None if it is prompt, or without a kind."""
    return None if kind in (None, PROMPT) else LINE_KINDS[kind].delays(line)


_PIECE = 0.01  # s; wire time of a piece that arrives together


class SimulatedLine:
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

        With the same time for several lines, their data arrive simultaneously.
        """
        now = threads.now() if now is None else now
        arriving = self._faults.pass_on(
            frame, toward=self._toward, time=now, finds_damage=self._finds_damage
        )
        for delay, data in arriving:
            leaves = now
            if self._delays is not None and self._toward == "amplifier":
                leaves = self._delays.leave(now, len(data))
            length = max(len(data), 1)  # no bytes: the end of a connection
            piece_length = length
            if self._byte_time:
                piece_length = max(int(_PIECE / self._byte_time), 1)
            for start in range(0, length, piece_length):
                piece = data[start : start + piece_length]
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
    """Both directions: `inward` to the amplifier, `outward` to the host; see `SimulatedLine`.

    to_host: called with the frames for the host; delays: None for none.
    """

    to_amplifier: Callable[[bytes, float], None]
    """Called with the frames for the amplifier, and when [s] they arrive; set before the first."""

    def __init__(
        self,
        to_host: Callable[[bytes], None],
        *,
        faults: Faults,
        delays: LineDelays | None = None,
        byte_time: float = 0.0,
        finds_damage: bool = False,
    ) -> None:
        self._to_host = to_host
        make = partial(
            SimulatedLine,
            faults=faults,
            delays=delays,
            byte_time=byte_time,
            finds_damage=finds_damage,
        )
        self.inward = make(self._reach_amplifier, toward="amplifier")
        self.outward = make(self._reach_host, toward="host")

    def close(self) -> None:
        """Discard the frames in flight."""
        self.inward.close()
        self.outward.close()

    def _reach_amplifier(self, frame: bytes, now: float) -> None:
        self.to_amplifier(frame, now)

    def _reach_host(self, frame: bytes, now: float) -> None:
        self._to_host(frame)

"""The clock of a software amplifier, as a made-up JACK server says when a block is played."""

import ctypes
import multiprocessing
import socket
import struct
from collections.abc import Callable
from dataclasses import dataclass
from multiprocessing.connection import Connection

import pytest
from cobs import cobs

import hand_written as hand
from sim.soft_amp.engine import (
    Counters,
    JackCalls,
    Protocol,
    Settings,
    library,
    start_engine,
    take_over,
)

pytestmark = pytest.mark.needs("cc")

RATE, BLOCK = 48_000, 128
TURN = 20.0  # s
TOLERANCE = 2e-8  # s; four steps of the clock


@dataclass
class MadeUpJack:
    """A server whose cycles begin when they are due; late [us]: by which it calls the engine."""

    frame: int = 0
    latency: int = 0
    late: int = 0

    def __post_init__(self) -> None:
        self._block = (ctypes.c_float * BLOCK)()
        pointer, number = ctypes.c_void_p, ctypes.c_int
        times = [pointer, *(ctypes.POINTER(each) for each in (ctypes.c_uint32, ctypes.c_uint64))]
        self._kept = {
            "buffer": self._made(
                lambda *_: ctypes.addressof(self._block), pointer, pointer, number
            ),
            "cycle_times": self._made(self._cycle, number, *times, pointer, pointer),
            "time": self._made(lambda: self._due + self.late, ctypes.c_uint64),
            "latency": self._made(
                self._latency, None, pointer, number, ctypes.POINTER(ctypes.c_uint32)
            ),
            "is_realtime": self._made(lambda _: 0, number, pointer),
        }

    @staticmethod
    def _made(function: Callable[..., object], *types: object) -> ctypes._CFuncPtr:
        return ctypes.CFUNCTYPE(*types)(function)

    @property
    def _due(self) -> int:
        return round(self.frame * 1e6 / RATE)

    def _cycle(self, _: int, frame: ctypes.Array, at: ctypes.Array, *__: object) -> int:
        frame[0], at[0] = self.frame, self._due
        return 0

    def _latency(self, _: int, mode: int, found: ctypes.Array) -> None:
        found[0], found[1] = self.latency, self.latency * (mode == 1)  # of playback

    def calls(self) -> JackCalls:
        """What the engine calls."""
        calls = JackCalls()
        for name, made in self._kept.items():
            setattr(calls, name, ctypes.cast(made, ctypes.c_void_p))
        return calls


def play(results: Connection) -> None:
    """Send what clocks [s] an engine shows, less the frames that came out before their blocks.

    At first; then with a latency and a late call; then behind a hole of 480 frames.
    """
    jack, counters = MadeUpJack(), Counters()
    host, terminal = socket.socketpair()
    terminal.setblocking(False)
    settings = Settings("jack", 2, Protocol.SERIAL, "S")
    start_engine(
        settings, rate=RATE, counters=counters, is_recovering=False,
        terminal=terminal.fileno(), listening=-1, parent=-1,
    )  # fmt: skip
    library().sound_use_jack(ctypes.byref(jack.calls()))
    take_over()

    def run(served: int) -> int:
        """Let the server go on until so many requests were served; return the last frame."""
        since = jack.frame
        while counters.requests < served:
            since = jack.frame
            library().sound_jack_process(BLOCK, None)
            jack.frame += BLOCK
        return since

    def clock() -> float:
        host.sendall(hand.frame(hand.GET_STATUS, sequence=1))
        since = run(counters.requests + 1)
        data = b""
        while data.count(b"\0") < 2:
            data += host.recv(300)
        words = struct.unpack_from("<9H", cobs.decode(data.strip(b"\0")), 5)
        return float((words[7] << 16 | words[8]) / 2**32 * TURN - since / RATE)

    run(1)  # the host is there
    shown = [clock()]
    jack.latency, jack.late = 384, 70
    shown.append(clock())
    jack.frame += 480
    shown.append(clock())
    results.send(shown)


def test_clock_is_that_at_the_output() -> None:
    """Behind the samples by what the server holds, between them too; and lost ones count.

    In a process of its own, since the engine's threads have no end.
    """
    library()
    forked = multiprocessing.get_context("fork")
    results, theirs = forked.Pipe(duplex=False)
    process = forked.Process(target=play, args=(theirs,), daemon=True)
    process.start()
    try:
        assert results.poll(60)
        first, *others = results.recv()
    finally:
        process.kill()
        process.join()
    for other in others:
        behind = (first - other) % TURN
        assert behind == pytest.approx(384 / RATE - 70e-6, abs=TOLERANCE)

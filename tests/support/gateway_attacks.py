"""Attacks on a gateway, and whether a stop of a fresh client gets through meanwhile.

    python tests/support/gateway_attacks.py [--seconds S] [--only NAME ...] [--program ERA]

Prints a row for each: stops within half a second, the slowest, the most processor time of the
gateway within one (all that it does meanwhile), its memory before and at most, and what became of
the attackers. Each attack is a process of its own, as is the gateway; all
attackers come from one host, and those over a WebSocket have the token.
"""

import argparse
import asyncio
import contextlib
import itertools
import logging
import os
import resource
import socket
import subprocess
import sys
import tempfile
import threading
import time
from collections import Counter
from collections.abc import Awaitable, Callable, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import SimpleNamespace

from processes.gateways import (
    ERA,
    TOKEN,
    GatewayProcess,
    frame,
    gateway_process,
    http,
    real_daemon,
    upgrade,
    wait_for_daemon,
)

LIMIT = 0.5  # s; for a stop
_INTERVAL = 0.2  # s; between stops
_PATIENCE = 2.0  # s; for a stop, and for memory to settle
_CONNECTING = 8.0  # s
_TOUCH = b'{"jsonrpc":"2.0","method":"touch","params":{"source":"p","touches":[]}}'
_HELLO = b'{"jsonrpc":"2.0","id":1,"method":"hello","params":{"client":"me"}}'


class Attacker:
    """Attacks one gateway for a time [s]."""

    def __init__(self, port: int, seconds: float) -> None:
        self.seconds = seconds
        self._port = port
        self._upgrade = upgrade(SimpleNamespace(host=f"localhost:{port}"))  # type: ignore[arg-type]

    async def none(self) -> str:
        """Nothing, for comparison."""
        await asyncio.sleep(self.seconds)
        return ""

    async def storm(self) -> str:
        """Two thousand connections in a second, each closed after 20 ms."""
        begin = time.monotonic()
        count = 0
        while time.monotonic() < begin + self.seconds:
            for _ in range(20):
                made = socket.socket()
                made.setblocking(False)
                with contextlib.suppress(OSError):
                    made.connect(("127.0.0.1", self._port))
                asyncio.get_running_loop().call_later(0.02, made.close)
            count += 20
            await asyncio.sleep(max(0, begin + count / 2000 - time.monotonic()))
        return f"{count / self.seconds:.0f} in a second"

    async def many(self, count: int, attack: Callable[[int], Awaitable[str]]) -> str:
        """So many at once, each by its number; how many had which outcome."""
        tasks = []
        for number in range(count):
            tasks.append(asyncio.create_task(attack(number)))
            await asyncio.sleep(0.002)
        outcomes = Counter(await asyncio.gather(*tasks))
        return ", ".join(f"{count} {outcome}" for outcome, count in outcomes.most_common())

    async def send(
        self, head: bytes, then: Iterable[bytes], *, every: float = 0.0, reads: bool = True
    ) -> str:
        """Send bytes, then others with pauses [s] between, until it is closed or the time over.

        Returns the status that is read, if any, and how it ended: refused, closed or held.
        """
        try:
            async with asyncio.timeout(_CONNECTING):
                reader, writer = await asyncio.open_connection("127.0.0.1", self._port)
        except OSError:
            return "refused"
        received = bytearray()

        async def read() -> None:
            while part := await reader.read(1 << 16):
                received.extend(part[: 12 - len(received)])

        reading = asyncio.create_task(read() if reads else asyncio.sleep(self.seconds))
        if not reads:
            writer.transport.pause_reading()  # type: ignore[attr-defined]
        with contextlib.suppress(TimeoutError, ConnectionError):
            async with asyncio.timeout(self.seconds):
                for piece in itertools.chain([head], then):
                    writer.write(piece)
                    await writer.drain()
                    await asyncio.sleep(every)
                    if reading.done():
                        break
                await asyncio.wait([reading])
        outcome = "closed" if reading.done() or writer.transport.is_closing() else "held"
        reading.cancel()
        await asyncio.gather(reading, return_exceptions=True)
        writer.transport.abort()
        return f"{received[9:].decode()} {outcome}".strip()

    async def pipeline(self, requests: bytes) -> str:
        """Send requests at once and read nothing; again over a new connection every half second."""
        refused = 0
        end = time.monotonic() + self.seconds
        while time.monotonic() < end:
            try:
                async with asyncio.timeout(_CONNECTING):
                    _, writer = await asyncio.open_connection("127.0.0.1", self._port)
            except OSError:
                refused += 1
                continue
            writer.transport.pause_reading()  # type: ignore[attr-defined]
            writer.write(requests)
            await asyncio.sleep(0.5)
            writer.transport.abort()
        return "refused at times" if refused else "sent all the while"

    def frames(self, data: bytes, *, reads: bool = False) -> Callable[[int], Awaitable[str]]:
        """Frames without pause over a WebSocket, whose own frames are read or not."""
        return lambda _: self.send(self._upgrade, itertools.repeat(data), reads=reads)


def _slow_body(number: int) -> bytes:
    """The head of a request, with the token or without."""
    token = "Authorization: Bearer " + TOKEN if number % 2 else "X: y"
    head = f"POST /api/v1/stop HTTP/1.1\r\nHost: localhost\r\n{token}\r\n"
    return f"{head}Content-Type: application/json\r\nContent-Length: 5000\r\n\r\n".encode()


def _large_head(number: int) -> list[bytes]:
    """A line of 100 KB, two hundred lines, or lines without end."""
    return (
        [b"X-a: " + b"x" * 100_000 + b"\r\n\r\n"],
        [b"X-a: " + b"x" * 500 + b"\r\n"] * 200 + [b"\r\n"],
        [b"X-a: " + b"x" * 500 + b"\r\n"] * 100_000,
    )[number % 3]


def _large_body(number: int) -> list[bytes]:
    """A hundred megabytes, sized or chunked, with the token or without."""
    token = f"Authorization: Bearer {TOKEN}\r\n".encode() if number % 2 else b""
    if number % 4 < 2:
        return [token + b"Content-Length: 100000000\r\n\r\n"] + [b" " * 65536] * 1526
    chunk = b"10000\r\n" + b" " * 65536 + b"\r\n"
    return [token + b"Transfer-Encoding: chunked\r\n\r\n"] + [chunk] * 1526


_GET = b"GET / HTTP/1.1\r\nHost: localhost\r\n"
_PAGE = b"GET /app.js HTTP/1.1\r\nHost: localhost\r\n\r\n"
_PAGE_BY_TOKEN = _PAGE[:-2] + f"Authorization: Bearer {TOKEN}\r\n\r\n".encode()
_ARM = b"POST /api/v1/arm HTTP/1.1\r\nHost: localhost\r\nContent-Type: application/json\r\n"
ATTACKS: dict[str, Callable[[Attacker], Awaitable[str]]] = {
    "none": Attacker.none,
    "2 000 connections/s": Attacker.storm,
    "300 slow heads, a byte per 0.5 s": lambda a: a.many(
        300, lambda _: a.send(b"GET / HTTP/1.1\r\n", itertools.repeat(b" "), every=0.5)
    ),
    "200 slow bodies, half with the token": lambda a: a.many(
        200, lambda number: a.send(_slow_body(number), itertools.repeat(b" "), every=0.5)
    ),
    "400 connections idle after a request": lambda a: a.many(
        400, lambda _: a.send(b"GET /none HTTP/1.1\r\nHost: localhost\r\n\r\n", [])
    ),
    "12 heads of 100 KB, or endless": lambda a: a.many(
        12, lambda number: a.send(_GET, _large_head(number))
    ),
    "8 bodies of 100 MB, sized or chunked": lambda a: a.many(
        8, lambda number: a.send(_ARM, _large_body(number))
    ),
    "200 connections, 200 pages each unread": lambda a: a.many(
        200, lambda _: a.send(_PAGE * 200, itertools.repeat(b"\r\n"), every=0.2, reads=False)
    ),
    "120 clients, 60 pages at once, unread": lambda a: a.many(
        120, lambda _: a.pipeline(_PAGE * 60)
    ),
    "120 clients with the token, 60 pages at once, unread": lambda a: a.many(
        120, lambda _: a.pipeline(_PAGE_BY_TOKEN * 60)
    ),
    "20 WebSockets, replies unread": lambda a: a.many(20, a.frames(frame(_HELLO) * 500)),
    "8 WebSockets, texts of 2 bytes": lambda a: a.many(
        8, a.frames(frame(b"{}") * 5000, reads=True)
    ),
    "8 WebSockets, touches": lambda a: a.many(8, a.frames(frame(_TOUCH) * 500, reads=True)),
}


@dataclass
class Stop:
    """A stop by a fresh client: whether it was carried out, how long [s] it and the gateway took.

    processor: time of the gateway's event loop on a processor from its beginning to its end, which
    other programs do not lengthen.
    """

    is_done: bool
    duration: float
    processor: float


@dataclass
class Outcome:
    """What an attack did to a gateway."""

    stops: list[Stop]
    memory_before: float  # MB
    memory_most: float  # MB
    attackers: str

    def row(self, name: str) -> str:
        """As a row of a table."""
        in_time = sum(each.is_done and each.duration <= LIMIT for each in self.stops)
        slowest = max(each.duration for each in self.stops)
        processor = max(each.processor for each in self.stops)
        return (
            f"| {name} | {in_time} of {len(self.stops)} | {1e3 * slowest:.0f} "
            f"| {1e3 * processor:.0f} | {self.memory_before:.0f} → {self.memory_most:.0f} "
            f"| {self.attackers} |"
        )


def attack(gateway: GatewayProcess, name: str, seconds: float) -> Outcome:
    """Attack a gateway, and stop all the while."""
    outcome = Outcome([], _memory(gateway), _memory(gateway), "")
    arguments = (name, str(gateway.port), str(seconds))
    attacking = subprocess.Popen(
        [sys.executable, __file__, "--attack", *arguments], stdout=subprocess.PIPE, text=True
    )
    over = threading.Event()
    watching = threading.Thread(target=_watch, args=(gateway, outcome, over))
    watching.start()
    try:
        while attacking.poll() is None:
            begin = time.monotonic()
            outcome.stops.append(_stop(gateway))
            time.sleep(max(0.0, begin + _INTERVAL - time.monotonic()))
        outcome.attackers = attacking.stdout.read().strip()
        assert attacking.returncode == 0, "the attackers have failed"
    finally:
        over.set()
        watching.join()
        attacking.kill()
        attacking.communicate()
    return outcome


def _stop(gateway: GatewayProcess) -> Stop:
    """Stop by a fresh client."""
    begin, processor = time.monotonic(), _processor(gateway)
    is_done = False
    with contextlib.suppress(OSError):
        is_done = http(gateway, "/api/v1/stop", body=b"", timeout=_PATIENCE).status == 200
    return Stop(is_done, time.monotonic() - begin, _processor(gateway) - processor)


def _processor(gateway: GatewayProcess) -> float:
    """Time of its main thread on a processor [s]."""
    return int(Path(f"/proc/{gateway.process.pid}/schedstat").read_text().split()[0]) / 1e9


def _watch(gateway: GatewayProcess, outcome: Outcome, over: threading.Event) -> None:
    while not over.wait(0.03):
        outcome.memory_most = max(outcome.memory_most, _memory(gateway))


def _memory(gateway: GatewayProcess) -> float:
    """Resident memory [MB]."""
    pages = int(Path(f"/proc/{gateway.process.pid}/statm").read_text().split()[1])
    return pages * resource.getpagesize() / 1e6


def main(arguments: Sequence[str]) -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seconds", type=float, default=6.0)
    parser.add_argument("--only", nargs="*", default=list(ATTACKS))
    parser.add_argument("--program", default=ERA)
    given = parser.parse_args(arguments)
    _print("| attack | stops within 0.5 s | slowest, ms | processor, ms | memory, MB | attackers |")
    _print("|---|---|---|---|---|---|")
    with tempfile.TemporaryDirectory() as folder, real_daemon(Path(folder)) as daemon:
        for name in given.only:
            with gateway_process(Path(folder), daemon, program=(given.program,)) as gateway:
                wait_for_daemon(gateway)
                _print(attack(gateway, name, given.seconds).row(name))


def _attack(name: str, port: str, seconds: str) -> None:
    logging.disable()
    os.nice(10)  # as the gateway; attackers elsewhere would take none of its processor
    most = resource.getrlimit(resource.RLIMIT_NOFILE)[1]
    resource.setrlimit(resource.RLIMIT_NOFILE, (most, most))
    attacker = Attacker(int(port), float(seconds))

    async def run() -> str:
        return await ATTACKS[name](attacker)

    _print(asyncio.run(run()))


def _print(text: str) -> None:
    sys.stdout.write(f"{text}\n")
    sys.stdout.flush()


if __name__ == "__main__":
    if sys.argv[1:2] == ["--attack"]:
        _attack(*sys.argv[2:])
    else:
        main(sys.argv[1:])

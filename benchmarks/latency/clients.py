"""Programs of the latency benchmark: a panel, a client that floods, and CPU load.

    python -m benchmarks.latency.clients panel RIG PORT FILE KIND COUNT RATE SEED
    python -m benchmarks.latency.clients flood SOCKET RIG RATE
    python -m benchmarks.latency.clients work

The panel writes the time of each datagram, on CLOCK_MONOTONIC [ns]. Late ones are sent at once, to
keep the rate.
"""

import json
import socket
import sys
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np

from benchmarks.latency.touches import FLOODING, WANDERS, Work, datagrams
from model.rig.file import load_rig

BATCH = 10  # messages of the flood at a time


def panel(rig: str, port: str, file: str, kind: str, count: str, rate: str, seed: str) -> None:
    work = Work(kind, int(count), float(rate), int(seed))
    ready = list(datagrams(work, load_rig(Path(rig)).plate))
    sent = np.zeros(len(ready), dtype=np.int64)
    line = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    line.connect(("127.0.0.1", int(port)))
    print("ready", flush=True)
    sys.stdin.readline()
    begin = time.monotonic_ns()
    for number, datagram in enumerate(ready):
        _wait_until(begin + int(number * 1e9 / work.rate))
        sent[number] = time.monotonic_ns()
        line.send(datagram)
    print("sent", flush=True)
    sys.stdin.readline()  # while the others are measured
    np.save(file, sent)


def flood(path: str, rig: str, rate: str) -> None:
    plate = load_rig(Path(rig)).plate
    line = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
    line.connect(path)
    x, y = FLOODING[0] * plate.length, FLOODING[1] * plate.width
    messages = [_touch(x + step * WANDERS / BATCH, y) for step in range(BATCH)]
    begin, sent = time.monotonic_ns(), 0
    print("flooding", flush=True)
    while True:
        line.sendall(b"".join(messages))
        sent += BATCH
        _wait_until(begin + int(sent * 1e9 / float(rate)))


def work() -> None:
    while True:
        sum(range(10_000))


def _touch(x: float, y: float) -> bytes:
    touches = [{"id": 1, "x_m": x, "y_m": y}]
    params = {"source": "flood", "touches": touches}
    return json.dumps({"jsonrpc": "2.0", "method": "touch", "params": params}).encode() + b"\n"


def _wait_until(moment: int) -> None:
    """Sleep until a time [ns]."""
    left = moment - time.monotonic_ns()
    if left > 0:
        time.sleep(left * 1e-9)


if __name__ == "__main__":
    programs: dict[str, Callable[..., None]] = {
        "panel": panel,
        "flood": flood,
        "work": work,
    }
    programs[sys.argv[1]](*sys.argv[2:])

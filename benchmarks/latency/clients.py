"""Programs of the latency benchmark: a panel, clients that flood, and CPU load.

    python -m benchmarks.latency.clients panel RIG PORT FILE KIND COUNT RATE SEED [REPEATS_AFTER]
    python -m benchmarks.latency.clients flood SOCKET RIG RATE
    python -m benchmarks.latency.clients flooder KIND SOCKET
    python -m benchmarks.latency.clients stopper SOCKET COUNT FILE
    python -m benchmarks.latency.clients work

The panel writes the time of each datagram, on CLOCK_MONOTONIC [ns]. Late ones are sent at once, to
keep the rate. The stopper writes the time of each `stop` from request to response [s].
"""

import contextlib
import json
import select
import socket
import sys
import time
from collections import deque
from collections.abc import Callable
from pathlib import Path

import numpy as np

from benchmarks.latency.touches import FLOODING, WANDERS, Work, datagrams
from controller.api.jsonrpc import ErrorCode
from model.rig.file import load_rig

BATCH = 10  # messages of the flood at a time


def panel(rig: str, port: str, file: str, kind: str, count: str, rate: str, *others: str) -> None:
    work = Work(kind, int(count), float(rate), *map(int, others))
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


def flooder(kind: str, path: str) -> None:
    """Send as much of one kind as is taken, over a new connection when it is closed."""
    data = FLOODS[kind]
    silent: deque[socket.socket] = deque()
    print("flooding", flush=True)
    while True:
        line = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
        line.settimeout(0.1)
        with contextlib.suppress(OSError):
            line.connect(path)
            while data:
                line.sendall(data)
                while select.select([line], [], [], 0)[0] and line.recv(1 << 16):
                    pass
        silent.append(line)
        while len(silent) > (0 if data else MAX_SILENT):
            silent.popleft().close()


def stopper(path: str, count: str, file: str) -> None:
    """Stop and clear again and again, at the priority of a device."""
    with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as line, line.makefile("rb") as answers:
        line.connect(path)

        def call(method: str) -> float:
            while True:
                begin = time.perf_counter()
                line.sendall(_request(method, "{}"))
                response = json.loads(answers.readline())
                duration = time.perf_counter() - begin
                if "error" not in response:
                    return duration
                if method == "stop" or response["error"]["code"] != ErrorCode.BUSY:
                    sys.exit(f"{method}: {response['error']}")

        times = []
        for _ in range(int(count)):
            times.append(call("stop"))
            call("clear")  # in reserve only once there is room
    np.save(file, times)


def work() -> None:
    while True:
        sum(range(10_000))


def _touch(x: float, y: float) -> bytes:
    touches = [{"id": 1, "x_m": x, "y_m": y}]
    params = {"source": "flood", "touches": touches}
    return json.dumps({"jsonrpc": "2.0", "method": "touch", "params": params}).encode() + b"\n"


def _request(method: str, params: str) -> bytes:
    return f'{{"jsonrpc":"2.0","id":1,"method":"{method}","params":{params}}}\n'.encode()


MAX_SILENT = 100  # connections of one flooder
FLOODS = {
    "touches": _request("touch", '{"source":"flood","touches":[]}') * 100,
    "requests": _request("status", "{}") * 100,
    "keys": _request("status", "{" + ",".join(f'"{n:05d}":1' for n in range(6000)) + "}"),
    "newlines": b"\n" * (1 << 18),
    "stops": _request("renew", '{"lease":"stop"}') * 100,
    "connections": b"",
}
"""What a flooder sends, by kind. Stops would disarm, so they are lines that look like one."""


def _wait_until(moment: int) -> None:
    """Sleep until a time [ns]."""
    left = moment - time.monotonic_ns()
    if left > 0:
        time.sleep(left * 1e-9)


if __name__ == "__main__":
    programs: dict[str, Callable[..., None]] = {
        "panel": panel,
        "flood": flood,
        "flooder": flooder,
        "stopper": stopper,
        "work": work,
    }
    programs[sys.argv[1]](*sys.argv[2:])

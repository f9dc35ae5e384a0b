"""Control of a running far end: JSON, a line each way, over a Unix socket for its owner only.

    {"op": "fingers", "fingers": {ID: [x, y], ...}}         these fingers rest here [m], no others
        {"ok": true, "time_s": t}
    {"op": "felt", "since_s": t0, "until_s": t1}            at most the last ten seconds
        {"fingers": {ID: {"points_m": [[x, y], ...], "frequencies_hz": [f, ...],
                          "amplitude_m_s2": [[one per point], one row per frequency],
                          "peak_m_s2": [one per point]}, ...}}
    {"op": "state"}
        {"time_s": t, "fingers": {ID: [x, y]}, "amplifiers": {NAME: {"state", "fault", "token",
         "high_voltage", "levels"}}}

Times are those of time.monotonic() [s]. What is wrong gets {"error": TEXT} and changes nothing.
"""

import asyncio
import contextlib
import json
import math
import os
import socket
from collections.abc import AsyncIterator, Callable, Mapping, Sequence
from contextlib import asynccontextmanager
from pathlib import Path
from typing import Any, TypeGuard

from drivers import clock
from drivers.errors import LinkError
from model.errors import InputError
from sim.bench import Bench
from sim.felt import feel
from sim.finger import Record

LINE_MAX = 64 * 1024  # bytes; thirty fingers take a tenth of it


def carry_out(bench: Bench, line: bytes, *, now: float) -> Callable[[], dict[str, Any]]:
    """Do what one line of control asks now [s]; returns what makes the answer to it.

    Making it may take long and touches nothing of the bench any more: any thread may do it.
    """
    try:
        request = json.loads(line)
        if not isinstance(request, dict):
            raise InputError("a line must be a JSON object")
        match request.get("op"):
            case "fingers":
                positions = _positions(request)
                bench.place_fingers(positions, now=now)
                return _already({"ok": True, "time_s": bench.time})
            case "felt":
                since, until = _number(request, "since_s"), _number(request, "until_s")
                if since >= until:
                    raise InputError(f"since_s {since} must come before until_s {until}")
                bench.advance(now)
                records, frequencies = bench.records(since, until)
                return lambda: _felt(records, frequencies)
            case "state":
                bench.advance(now)
                return _already(_state(bench))
            case other:
                raise InputError(f"op is {str(other)[:40]!r}; it must be fingers, felt or state")
    except (json.JSONDecodeError, UnicodeDecodeError, RecursionError) as error:
        return _already({"error": f"not a line of JSON: {error}"})
    except InputError as error:
        return _already({"error": str(error)})


@asynccontextmanager
async def control_socket(bench: Bench, path: Path) -> AsyncIterator[None]:
    """Serve control of a bench at a path; raises LinkError where no socket can be made."""
    sock = _bind(path)
    loop = asyncio.get_running_loop()
    clients: dict[asyncio.Task[None], socket.socket] = {}

    def forget(client: asyncio.Task[None]) -> None:
        clients.pop(client).close()

    def accept() -> None:
        try:
            connection, _ = sock.accept()
        except OSError:  # the client has left again already
            return
        connection.setblocking(False)
        client = loop.create_task(_converse(bench, connection), name=f"control at {path}")
        clients[client] = connection
        client.add_done_callback(forget)

    loop.add_reader(sock, accept)
    try:
        yield
    finally:
        loop.remove_reader(sock)
        sock.close()
        _remove(path)
        for client in clients:
            client.cancel()
        await asyncio.gather(*clients, return_exceptions=True)


async def _converse(bench: Bench, connection: socket.socket) -> None:
    """Answer a client line by line until it leaves. Plain sockets: no transport to outlive us."""
    loop = asyncio.get_running_loop()
    rest = b""
    with contextlib.suppress(ConnectionError):
        while data := await loop.sock_recv(connection, LINE_MAX):
            *lines, rest = (rest + data).split(b"\n")
            for line in lines:
                make_answer = carry_out(bench, line, now=clock.now())
                # A long fit must not hold up the amplifiers, whose hosts wait for 50 ms at most.
                reply = await asyncio.to_thread(_encode_made, make_answer)
                await loop.sock_sendall(connection, reply)
            if len(rest) > LINE_MAX:  # where the next line starts will never be known: hang up
                error = {"error": f"a line is longer than {LINE_MAX} bytes"}
                await loop.sock_sendall(connection, _encode(error))
                return


def _encode_made(make_answer: Callable[[], dict[str, Any]]) -> bytes:
    return _encode(make_answer())


def _encode(reply: dict[str, Any]) -> bytes:
    return json.dumps(reply, separators=(",", ":")).encode() + b"\n"


def _bind(path: Path) -> socket.socket:
    """A listening socket that only its owner may use; takes the place of one that is dead."""
    sock = socket.socket(socket.AF_UNIX)
    mask = os.umask(0o177)  # from its first moment on
    try:
        if path.is_socket() and _is_dead(path):
            path.unlink()
        sock.bind(str(path))
        sock.listen()
        sock.setblocking(False)
    except OSError as error:
        sock.close()
        raise LinkError(
            f"no control socket can be made at {path} ({error.strerror or error}): give a path "
            "of under 100 characters in a folder of yours that no other program serves at"
        ) from error
    finally:
        os.umask(mask)
    return sock


def _remove(path: Path) -> None:
    path.unlink(missing_ok=True)


def _is_dead(path: Path) -> bool:
    with socket.socket(socket.AF_UNIX) as probe:
        try:
            probe.connect(str(path))
        except ConnectionRefusedError:
            return True
    return False


def _number(request: dict[str, Any], key: str) -> float:
    value = request.get(key)
    if not _is_number(value):
        raise InputError(f"{key} is {str(value)[:40]!r}; it must be a number of seconds")
    return float(value)


def _is_number(value: object) -> TypeGuard[int | float]:
    if isinstance(value, bool) or not isinstance(value, int | float):
        return False
    try:
        return math.isfinite(value)
    except OverflowError:  # JSON allows integers of any length
        return False


def _positions(request: dict[str, Any]) -> dict[str, tuple[float, float]]:
    fingers = request.get("fingers")
    if not isinstance(fingers, dict):
        raise InputError('fingers must be an object of positions, as in {"1": [0.10, 0.08]}')
    positions = {}
    for name, position in fingers.items():
        pair = isinstance(position, list) and len(position) == 2
        if not (pair and all(_is_number(part) for part in position)):
            raise InputError(f"finger {name[:40]!r} needs a position [x, y] in metres")
        positions[name] = (float(position[0]), float(position[1]))
    return positions


def _already(reply: dict[str, Any]) -> Callable[[], dict[str, Any]]:
    return lambda: reply


def _felt(records: Mapping[str, Record], frequencies: Sequence[float]) -> dict[str, Any]:
    fingers = {}
    for name, record in records.items():
        felt = feel(record, frequencies)
        fingers[name] = {
            "points_m": felt.points.tolist(),
            "frequencies_hz": list(felt.frequencies),
            "amplitude_m_s2": felt.amplitude.tolist(),
            "peak_m_s2": felt.peak.tolist(),
        }
    return {"fingers": fingers}


def _state(bench: Bench) -> dict[str, Any]:
    amplifiers = {}
    for name, amplifier in bench.amplifiers.items():
        status = amplifier.status(bench.time)
        amplifiers[name] = {
            "state": status.state.name,
            "fault": status.fault.name,
            "token": status.token,
            "high_voltage": status.high_voltage,
            "levels": list(status.levels),
        }
    fingers = {name: list(place) for name, place in bench.fingers.layout.positions.items()}
    return {"time_s": bench.time, "fingers": fingers, "amplifiers": amplifiers}

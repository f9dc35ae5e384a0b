"""Control of a running simulation: its context, and JSON lines over a Unix socket, version 3.

Only the owner of the socket may open it. One JSON object per line in each direction; keys that a
request does not know are ignored.

    {"op": "hello"}                            {"protocol": "era-sim-control", "version": 3,
                                                "clock": "wall" or "virtual", "ops": [...],
                                                "urls": {NAME: URL}}
    {"op": "state"}                            {"time_s": t, "fingers": {ID: [x, y]},
                                                "amplifiers": {NAME: {"state", "fault", "token",
                                                "high_voltage", "levels"}}}

    fingers, positions [x, y] in metres
    {"op": "fingers", "fingers": {ID: [x, y]}, "observers": [ID, ...], "loads": {ID: factor}}
                                               replace all fingers; observers load nothing, others
                                               as the rig's fingertip times their load:
                                               {"ok": true, "time_s"}
    {"op": "touch", "finger": ID, "at_m": [x, y], "load": factor}      add one; "move": move one
    {"op": "lift", "finger": ID}                       remove one
    {"op": "felt", "since_s": t0, "until_s": t1}
        {"fingers": {ID: {"points_m": [[x, y], ...], "weights": [one per point, sum 1],
                          "frequencies_hz": [f, ...],
                          "amplitude_m_s2": [[one per point], one row per frequency],
                          "peak_m_s2": [one per point]}}}

    {"op": "inject_fault", "fault": ..., "lasts": ..., ...}   keys as in a fault file, begins now
    {"op": "faults"}                                   {"faults": {NAME: [{"fault", "begin_s",
                                                           "end_s" or null, "is_on"}]}}
    {"op": "recover", "amplifier": NAME}               end all faults; of all without a name
    {"op": "step", "seconds": s}                       advance virtual time: {"time_s": t}

Times are seconds of the simulation's clock: time.monotonic(), or virtual time from 0. `felt` covers
the last ten seconds. An invalid request returns {"error": TEXT} and changes nothing.
"""

import asyncio
import contextlib
import json
import math
import os
import socket
from collections.abc import (
    AsyncIterator,
    Awaitable,
    Callable,
    Collection,
    Coroutine,
    Mapping,
    Sequence,
)
from contextlib import asynccontextmanager
from dataclasses import dataclass, field
from inspect import signature
from pathlib import Path
from typing import Annotated, Any, Literal, TypeAlias

from pydantic import BaseModel, ConfigDict, Field, FiniteFloat, ValidationError

from drivers.errors import LinkError
from model.arrays import Point
from model.errors import InputError
from registry import threads
from registry.wording import first_problem
from sim.bench.amplifier_device import AmplifierDevice
from sim.bench.bench import Bench
from sim.faults import parse_fault
from sim.plant.fingers import measure_vibration

_MAX_STEP = 3600.0  # s of virtual time in one request
_MAX_KEY = 60  # characters of a key in an error
_At = Annotated[tuple[FiniteFloat, FiniteFloat], Field(strict=False)]  # [x, y] in m
_Positive = Annotated[FiniteFloat, Field(gt=0)]
_Finger = Annotated[str, Field(min_length=1, max_length=40)]  # its id


@dataclass
class SimulationContext:
    """A bench with its devices on wires and their URLs, both by name.

    step: advances virtual time [s], None in real time.
    """

    bench: Bench
    devices: Mapping[str, AmplifierDevice] = field(default_factory=dict)
    urls: Mapping[str, str] = field(default_factory=dict)
    step: Callable[[float], Coroutine[Any, Any, None]] | None = None
    _solving: asyncio.Task[None] | None = field(init=False, default=None)

    def start_solving(self) -> None:
        """Solve the plate under the newest fingers in a thread, so that amplifiers go on replying.

        At once in virtual time.
        """
        if self.step is not None:
            return  # the first who reads the plate solves it
        if self._solving is None or self._solving.done():
            self._solving = asyncio.create_task(self.solved(math.inf), name="solve the plate")

    async def solved(self, until: float) -> None:
        """Solve the plate under the fingers up to a time [s], or wait until it is."""
        while (placement := self.bench.unsolved) is not None and placement.time <= until:
            # An error is raised once more where the plate is read.
            await asyncio.gather(asyncio.to_thread(placement.solved), return_exceptions=True)

    async def stop_solving(self) -> None:
        """Leave what is unsolved."""
        if self._solving is not None:
            self._solving.cancel()
            await asyncio.wait({self._solving})

    def devices_of(self, amplifier: str | None) -> Sequence[AmplifierDevice]:
        """The device of an amplifier, or all devices; InputError for an unknown name."""
        if amplifier is None:
            return tuple(self.devices.values())
        if amplifier not in self.devices:
            known = ", ".join(self.devices) or "(none on a wire)"
            raise InputError(f"amplifier must be one of {known}, got {str(amplifier)[:40]!r}")
        return (self.devices[amplifier],)


_Response: TypeAlias = dict[str, Any]
_Function: TypeAlias = Callable[..., Awaitable[_Response]]

OPERATIONS: dict[str, tuple[type[BaseModel], _Function]] = {}
"""The operations by name, in the order of `hello`: keys of a request, and what carries it out."""


def operation(
    *names: str, extra: Literal["allow", "ignore"] = "ignore"
) -> Callable[[_Function], _Function]:
    """Register a function as the operations with these names; extra: type of further keys.

    It is called with the context, the time [s] and the keys of a request, which are its further
    parameters. It returns the response, or raises InputError and changes nothing.
    """

    def register(function: _Function) -> _Function:
        _, _, *keys = signature(function).parameters.values()
        keys = [each for each in keys if each.kind is each.KEYWORD_ONLY]
        form: dict[str, Any] = {
            "__module__": __name__,
            "__annotations__": {each.name: each.annotation for each in keys},
            "model_config": ConfigDict(frozen=True, strict=True, extra=extra),
            **{each.name: each.default for each in keys if each.default is not each.empty},
        }
        OPERATIONS.update(dict.fromkeys(names, (type(names[0], (BaseModel,), form), function)))
        return function

    return register


_VERSION = 3


@operation("hello")
async def _hello(context: SimulationContext, now: float) -> _Response:
    return {
        "protocol": "era-sim-control",
        "version": _VERSION,
        "clock": "wall" if context.step is None else "virtual",
        "ops": list(OPERATIONS),
        "urls": dict(context.urls),
    }


@operation("state")
async def _state(context: SimulationContext, now: float) -> _Response:
    bench = context.bench
    bench.advance(now)
    amplifiers = {}
    for name, amplifier in bench.amplifiers.items():
        summary = amplifier.summary(bench.time)
        amplifiers[name] = {
            "state": summary.state,
            "fault": summary.fault,
            "token": summary.token,
            "high_voltage": summary.is_high_voltage,
            "levels": list(summary.levels),
        }
    resting = {name: list(position) for name, position in bench.positions.items()}
    return {"time_s": bench.time, "fingers": resting, "amplifiers": amplifiers}


@operation("fingers")
async def _fingers(
    context: SimulationContext,
    now: float,
    *,
    fingers: dict[str, _At],
    observers: Annotated[list[str], Field(default_factory=list)],
    loads: Annotated[dict[str, FiniteFloat], Field(default_factory=dict)],
) -> _Response:
    if not {*observers, *loads} <= fingers.keys():
        raise InputError("observers and loads must name fingers of this request")
    return _placed(context, fingers, now, observers=observers, loads=loads)


@operation("touch", "move")
async def _touch_or_move(
    context: SimulationContext,
    now: float,
    *,
    op: str,
    finger: _Finger,
    at_m: _At | None = None,
    load: FiniteFloat | None = None,
) -> _Response:
    bench = context.bench
    if (finger in bench.positions) != (op == "move"):
        state = "already" if finger in bench.positions else "not"
        raise InputError(f"finger {finger!r} is {state} on the plate")
    if at_m is None:
        raise InputError("at_m: missing")
    loads = dict(bench.loads)
    if load is not None:
        loads[finger] = load
    positions = {**bench.positions, finger: at_m}
    return _placed(context, positions, now, observers=bench.observers, loads=loads)


@operation("lift")
async def _lift(context: SimulationContext, now: float, *, finger: _Finger) -> _Response:
    present = context.bench.positions
    if finger not in present:
        raise InputError(f"finger {finger!r} is not on the plate")
    rest = {id: at for id, at in present.items() if id != finger}
    return _placed(context, rest, now, observers=context.bench.observers, loads=context.bench.loads)


def _placed(
    context: SimulationContext,
    positions: Mapping[str, Point],
    now: float,
    *,
    observers: Collection[str],
    loads: Mapping[str, float],
) -> _Response:
    context.bench.begin_placing(positions, now=now, observers=observers, loads=loads)
    context.start_solving()
    return {"ok": True, "time_s": context.bench.time}


@operation("felt")
async def _felt(
    context: SimulationContext, now: float, *, since_s: FiniteFloat, until_s: FiniteFloat
) -> _Response:
    if since_s >= until_s:
        raise InputError("since_s must be less than until_s")
    # The fits run in threads, so that amplifiers go on replying.
    await context.solved(until_s)
    context.bench.advance(now)
    records, frequencies = context.bench.records(since_s, until_s)
    felt = {
        id: await asyncio.to_thread(measure_vibration, record, frequencies)
        for id, record in records.items()
    }
    return {
        "fingers": {
            id: {
                "points_m": one.points.tolist(),
                "weights": one.weights.tolist(),
                "frequencies_hz": list(one.frequencies),
                "amplitude_m_s2": one.amplitude.tolist(),
                "peak_m_s2": one.peak.tolist(),
            }
            for id, one in felt.items()
        }
    }


@operation("inject_fault", extra="allow")
async def _inject_fault(
    context: SimulationContext, now: float, *, op: str, **given: Any
) -> _Response:
    window = parse_fault(given)
    for device in context.devices_of(window.amplifier):
        device.inject_fault(window)
    return {"ok": True, "time_s": now}


@operation("faults")
async def _faults(context: SimulationContext, now: float) -> _Response:
    listed = {}
    for name, device in context.devices.items():
        begin = device.faults.begin
        listed[name] = [
            {
                "fault": window.fault,
                "begin_s": begin + window.at,
                "end_s": begin + window.end if math.isfinite(window.end) else None,
                "is_on": window.at <= now - begin < window.end,
            }
            for window in device.faults.windows
        ]
    return {"faults": listed}


@operation("recover")
async def _recover(context: SimulationContext, now: float, *, amplifier: Any = None) -> _Response:
    for device in context.devices_of(amplifier):
        device.recover()
    return {"ok": True, "time_s": now}


@operation("step")
async def _step(
    context: SimulationContext, now: float, *, seconds: Annotated[_Positive, Field(le=_MAX_STEP)]
) -> _Response:
    if context.step is None:
        raise InputError("step needs virtual time: start era sim with --virtual-time")
    await context.step(seconds)
    context.bench.advance(now + seconds)
    return {"ok": True, "time_s": context.bench.time}


async def execute(context: SimulationContext, line: bytes, *, now: float) -> _Response:
    """Execute one request line at a time [s]."""
    try:
        request = json.loads(line)
        if not isinstance(request, dict):
            raise InputError("a line must be a JSON object")
        op = request.get("op")
        if not isinstance(op, str) or op not in OPERATIONS:
            raise InputError(f"op must be one of {', '.join(OPERATIONS)}, got {str(op)[:40]!r}")
        form, function = OPERATIONS[op]
        return await function(context, now, **dict(form.model_validate(request)))
    except ValidationError as error:
        key, problem = first_problem(error)
        return {"error": f"{key[:_MAX_KEY]}: {problem}".removeprefix(": ")}
    except (json.JSONDecodeError, UnicodeDecodeError, RecursionError) as error:
        return {"error": f"invalid JSON: {error}"}
    except InputError as error:
        return {"error": str(error)}
    except OSError as error:
        problem = f"{error.filename or 'file'}: cannot be written: {error.strerror}"
        return {"error": problem if error.strerror else str(error)}


@asynccontextmanager
async def in_background(
    work: Coroutine[None, None, None], on_end: Callable[[], object] = lambda: None
) -> AsyncIterator[None]:
    """Run a task in the background; on_end: called when it ends, even by a failure."""
    task = asyncio.create_task(work)
    task.add_done_callback(lambda _: on_end())
    try:
        yield
    finally:
        task.cancel()
        with contextlib.suppress(asyncio.CancelledError):
            await task


LINE_MAX = 64 * 1024  # bytes; thirty fingers take a tenth of it


@asynccontextmanager
async def control_socket(context: SimulationContext, path: Path) -> AsyncIterator[None]:
    """Serve control at a path; raises LinkError where no socket can be created."""
    sock = _bind(path)
    loop = asyncio.get_running_loop()
    clients: dict[asyncio.Task[None], socket.socket] = {}

    def forget(client: asyncio.Task[None]) -> None:
        clients.pop(client).close()

    def accept() -> None:
        try:
            connection, _ = sock.accept()
        except OSError:  # the client has disconnected already
            return
        connection.setblocking(False)
        client = loop.create_task(_serve_client(context, connection), name=f"control at {path}")
        clients[client] = connection
        client.add_done_callback(forget)

    loop.add_reader(sock, accept)
    try:
        yield
    finally:
        loop.remove_reader(sock)
        sock.close()
        await asyncio.to_thread(path.unlink, missing_ok=True)
        for client in clients:
            client.cancel()
        await asyncio.gather(*clients, return_exceptions=True)
        await context.stop_solving()


async def _serve_client(context: SimulationContext, connection: socket.socket) -> None:
    """Serve a client line by line until it disconnects."""
    loop = asyncio.get_running_loop()
    rest = b""
    with contextlib.suppress(ConnectionError):
        while data := await loop.sock_recv(connection, LINE_MAX):
            *lines, rest = (rest + data).split(b"\n")
            for line in lines:
                response = await execute(context, line, now=threads.now())
                await loop.sock_sendall(connection, await asyncio.to_thread(_encode, response))
            if len(rest) > LINE_MAX:  # the next line cannot be found
                error = {"error": f"line must be at most {LINE_MAX} bytes"}
                await loop.sock_sendall(connection, _encode(error))
                return


def _encode(reply: dict[str, Any]) -> bytes:
    return json.dumps(reply, separators=(",", ":")).encode() + b"\n"


def _bind(path: Path) -> socket.socket:
    """Create a listening socket for the owner only; a stale one is replaced."""
    sock = socket.socket(socket.AF_UNIX)
    mask = os.umask(0o177)
    try:
        if path.is_socket() and _is_dead(path):
            path.unlink()
        sock.bind(str(path))
        sock.listen()
        sock.setblocking(False)
    except OSError as error:
        sock.close()
        raise LinkError(
            f"{path}: cannot create control socket: {error.strerror or error}; give an unused path "
            "of under 100 characters in a writable folder"
        ) from error
    finally:
        os.umask(mask)
    return sock


def _is_dead(path: Path) -> bool:
    with socket.socket(socket.AF_UNIX) as probe:
        try:
            probe.connect(str(path))
        except ConnectionRefusedError:
            return True
    return False

"""Control of a running simulation: its context, and JSON lines over a Unix socket, version 3.

Only the owner of the socket may open it. One JSON object per line in each direction; unknown keys
of a request are ignored.

    {"op": "hello"}                            {"protocol": "era-sim-control", "version": 3,
                                                "clock": "wall" or "virtual", "ops": [...],
                                                "urls": {NAME: URL}}
    {"op": "state"}                            {"time_s": t, "fingers": {ID: [x, y]},
                                                "amplifiers": {NAME: {"state", "fault", "token",
                                                "high_voltage", "levels"}}}

    fingers, positions [x, y] in meters
    {"op": "fingers", "fingers": {ID: [x, y]}, "observers": [ID, ...], "loads": {ID: factor}}
                                               replace all fingers; observers load nothing, other
                                               fingers load as the rig's fingertip times "load":
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
from abc import abstractmethod
from collections.abc import (
    AsyncIterator,
    Callable,
    Collection,
    Coroutine,
    Mapping,
    Sequence,
)
from contextlib import asynccontextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, ClassVar, TypeAlias

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
_Position = Annotated[tuple[FiniteFloat, FiniteFloat], Field(strict=False)]  # [x, y] in m
_FingerId = Annotated[str, Field(min_length=1, max_length=40)]


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

        In virtual time the first reader of the plate solves it.
        """
        if self.step is not None:
            return
        if self._solving is None or self._solving.done():
            self._solving = asyncio.create_task(self.solved(math.inf), name="solve the plate")

    async def solved(self, until: float) -> None:
        """Solve the plate under the fingers up to a time [s], or wait until it is."""
        while (placement := self.bench.unsolved) is not None and placement.time <= until:
            # An error is raised again when the plate is read.
            await asyncio.gather(asyncio.to_thread(placement.solved), return_exceptions=True)

    async def stop_solving(self) -> None:
        """Stop solving; the current solution is abandoned."""
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


_VERSION = 3
_Response: TypeAlias = dict[str, Any]


class _Request(BaseModel):
    """A request. A subclass for each operation declares its keys, and carries it out.

    names: of the operation.
    """

    model_config = ConfigDict(frozen=True, strict=True, extra="ignore")
    names: ClassVar[tuple[str, ...]]

    @abstractmethod
    async def carry_out(self, context: SimulationContext, now: float) -> _Response:
        """Return the response at a time [s]; an InputError changes nothing."""


class _HelloRequest(_Request):
    names = ("hello",)

    async def carry_out(self, context: SimulationContext, now: float) -> _Response:
        return {
            "protocol": "era-sim-control",
            "version": _VERSION,
            "clock": "wall" if context.step is None else "virtual",
            "ops": list(OPERATIONS),
            "urls": dict(context.urls),
        }


class _StateRequest(_Request):
    names = ("state",)

    async def carry_out(self, context: SimulationContext, now: float) -> _Response:
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
        fingers = {finger: list(position) for finger, position in bench.positions.items()}
        return {"time_s": bench.time, "fingers": fingers, "amplifiers": amplifiers}


class _FingersRequest(_Request):
    names = ("fingers",)
    fingers: dict[str, _Position]
    observers: list[str] = Field(default_factory=list)
    loads: dict[str, FiniteFloat] = Field(default_factory=dict)

    async def carry_out(self, context: SimulationContext, now: float) -> _Response:
        if not {*self.observers, *self.loads} <= self.fingers.keys():
            raise InputError("observers and loads must name fingers of this request")
        return _place_fingers(
            context, self.fingers, now, observers=self.observers, loads=self.loads
        )


class _TouchOrMoveRequest(_Request):
    names = ("touch", "move")
    op: str
    finger: _FingerId
    at_m: _Position | None = None
    load: FiniteFloat | None = None

    async def carry_out(self, context: SimulationContext, now: float) -> _Response:
        bench = context.bench
        is_present = self.finger in bench.positions
        if is_present != (self.op == "move"):
            state = "already" if is_present else "not"
            raise InputError(f"finger {self.finger!r} is {state} on the plate")
        if self.at_m is None:
            raise InputError("at_m: missing")
        loads = dict(bench.loads)
        if self.load is not None:
            loads[self.finger] = self.load
        positions = {**bench.positions, self.finger: self.at_m}
        return _place_fingers(context, positions, now, observers=bench.observers, loads=loads)


class _LiftRequest(_Request):
    names = ("lift",)
    finger: _FingerId

    async def carry_out(self, context: SimulationContext, now: float) -> _Response:
        bench = context.bench
        if self.finger not in bench.positions:
            raise InputError(f"finger {self.finger!r} is not on the plate")
        positions = dict(bench.positions)
        del positions[self.finger]
        return _place_fingers(context, positions, now, observers=bench.observers, loads=bench.loads)


def _place_fingers(
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


class _FeltRequest(_Request):
    names = ("felt",)
    since_s: FiniteFloat
    until_s: FiniteFloat

    async def carry_out(self, context: SimulationContext, now: float) -> _Response:
        if self.since_s >= self.until_s:
            raise InputError("since_s must be less than until_s")
        await context.solved(self.until_s)
        context.bench.advance(now)
        records, frequencies = context.bench.records(self.since_s, self.until_s)
        fingers = {}
        for finger, record in records.items():
            # The fits run in threads, so that amplifiers go on replying.
            vibration = await asyncio.to_thread(measure_vibration, record, frequencies)
            fingers[finger] = {
                "points_m": vibration.points.tolist(),
                "weights": vibration.weights.tolist(),
                "frequencies_hz": list(vibration.frequencies),
                "amplitude_m_s2": vibration.amplitude.tolist(),
                "peak_m_s2": vibration.peak.tolist(),
            }
        return {"fingers": fingers}


class _InjectFaultRequest(_Request):
    model_config = ConfigDict(frozen=True, strict=True, extra="allow")
    names = ("inject_fault",)
    op: str

    async def carry_out(self, context: SimulationContext, now: float) -> _Response:
        window = parse_fault(self.model_extra or {})
        for device in context.devices_of(window.amplifier):
            device.inject_fault(window)
        return {"ok": True, "time_s": now}


class _FaultsRequest(_Request):
    names = ("faults",)

    async def carry_out(self, context: SimulationContext, now: float) -> _Response:
        faults = {}
        for name, device in context.devices.items():
            begin = device.faults.begin
            windows = []
            for window in device.faults.windows:
                end = begin + window.end
                entry = {
                    "fault": window.fault,
                    "begin_s": begin + window.at,
                    "end_s": end if math.isfinite(end) else None,
                    "is_on": window.at <= now - begin < window.end,
                }
                windows.append(entry)
            faults[name] = windows
        return {"faults": faults}


class _RecoverRequest(_Request):
    names = ("recover",)
    amplifier: Any = None

    async def carry_out(self, context: SimulationContext, now: float) -> _Response:
        for device in context.devices_of(self.amplifier):
            device.recover()
        return {"ok": True, "time_s": now}


class _StepRequest(_Request):
    names = ("step",)
    seconds: Annotated[FiniteFloat, Field(gt=0, le=_MAX_STEP)]

    async def carry_out(self, context: SimulationContext, now: float) -> _Response:
        if context.step is None:
            raise InputError("step needs virtual time: start era sim with --virtual-time")
        await context.step(self.seconds)
        context.bench.advance(now + self.seconds)
        return {"ok": True, "time_s": context.bench.time}


_REQUESTS: tuple[type[_Request], ...] = (
    _HelloRequest,
    _StateRequest,
    _FingersRequest,
    _TouchOrMoveRequest,
    _LiftRequest,
    _FeltRequest,
    _InjectFaultRequest,
    _FaultsRequest,
    _RecoverRequest,
    _StepRequest,
)

OPERATIONS: Mapping[str, type[_Request]] = {
    name: request for request in _REQUESTS for name in request.names
}
"""The operations by name, in the order of `hello`."""


async def execute(context: SimulationContext, line: bytes, *, now: float) -> _Response:
    """Execute one request line at a time [s]."""
    try:
        request = json.loads(line)
        if not isinstance(request, dict):
            raise InputError("a line must be a JSON object")
        op = request.get("op")
        if not isinstance(op, str) or op not in OPERATIONS:
            raise InputError(f"op must be one of {', '.join(OPERATIONS)}, got {str(op)[:40]!r}")
        return await OPERATIONS[op].model_validate(request).carry_out(context, now)
    except ValidationError as error:
        key, problem = first_problem(error)
        return {"error": f"{key[:_MAX_KEY]}: {problem}".removeprefix(": ")}
    except InputError as error:
        return {"error": str(error)}
    except (ValueError, RecursionError) as error:  # JSON, UTF-8, or a number with too many digits
        return {"error": f"invalid JSON: {error}"}
    except OSError as error:
        if not error.strerror:
            return {"error": str(error)}
        return {"error": f"{error.filename or 'file'}: cannot be written: {error.strerror}"}


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
    """Serve control at a path; raises LinkError if no socket can be created."""
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
    unfinished = b""
    with contextlib.suppress(ConnectionError):
        while data := await loop.sock_recv(connection, LINE_MAX):
            *lines, unfinished = (unfinished + data).split(b"\n")
            for line in lines:
                response = await execute(context, line, now=threads.now())
                await loop.sock_sendall(connection, await asyncio.to_thread(_encode, response))
            if len(unfinished) > LINE_MAX:  # the next line cannot be found
                error = {"error": f"line must be at most {LINE_MAX} bytes"}
                await loop.sock_sendall(connection, _encode(error))
                return


def _encode(reply: dict[str, Any]) -> bytes:
    return json.dumps(reply, separators=(",", ":")).encode() + b"\n"


def _bind(path: Path) -> socket.socket:
    """Create a listening socket for the owner only; a stale socket is replaced."""
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

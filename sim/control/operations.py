"""Operations of the control socket, version 3: one JSON object per line in each direction.

    {"op": "hello"}                            {"protocol": "era-sim-control", "version": 3,
                                                "clock": "wall" or "virtual", "ops": [...],
                                                "urls": {NAME: URL}}
    {"op": "state"}                            {"time_s": t, "fingers": {ID: [x, y]},
                                                "amplifiers": {NAME: {"state", "fault", "token",
                                                "high_voltage", "levels"}}}

    fingers, positions [x, y] in metres
    {"op": "fingers", "fingers": {ID: [x, y]}} replace all fingers: {"ok": true, "time_s"}
    {"op": "touch", "finger": ID, "at_m": [x, y]}      add one; "move": move one
    {"op": "lift", "finger": ID}                       remove one
    {"op": "felt", "since_s": t0, "until_s": t1}
        {"fingers": {ID: {"points_m": [[x, y], ...], "frequencies_hz": [f, ...],
                          "amplitude_m_s2": [[one per point], one row per frequency],
                          "peak_m_s2": [one per point]}}}

    sensors
    {"op": "sensors", "sensors": {NAME: {"at_m": [x, y], "noise_m_s2_rthz", "reach_m_s2",
                                         "resolution_m_s2", "scale"}}}
                                                       replace all sensors; only at_m is required
    {"op": "signals", "since_s": t0, "until_s": t1}    {"sample_rate_hz", "start_s",
                                                        "sensors": {NAME: {"at_m", "m_s2": [...]}}}
    {"op": "tones", "since_s", "until_s", "frequencies_hz": [f, ...]}
        {"sensors": {NAME: {"at_m", "real_m_s2": [one per frequency], "imag_m_s2": [...]}}}
        least squares over the signals; Im[a exp(i omega t)], t on the simulation's clock

    {"op": "inject_fault", "fault": ..., "lasts": ..., ...}   keys as in a fault file, begins now
    {"op": "faults"}                                   {"faults": {NAME: [{"fault", "begin_s",
                                                           "end_s" or null, "is_on"}]}}
    {"op": "recover", "amplifier": NAME}               end all faults; of all without a name
    {"op": "step", "seconds": s}                       advance virtual time: {"time_s": t}
    {"op": "record", "file": PATH}                     record the present sensors and fingers
    {"op": "finish"}                                   write it: {"file", "seconds", "is_full"}

Times are seconds of the simulation's clock: time.monotonic(), or virtual time from 0. Felt, signals
and tones cover the last ten seconds. An invalid request returns {"error": TEXT}
and changes nothing.
"""

import json
from collections.abc import Mapping

from model.errors import InputError
from sim.control import fault_operations, finger_operations, sensor_operations
from sim.control.context import SimulationContext
from sim.control.responses import (
    Deferred,
    Operation,
    Request,
    Response,
    ResponseBuilder,
    ready,
)
from sim.control.values import parse_number

VERSION = 3
_MAX_STEP = 3600.0  # s of virtual time in one request


def carry_out(context: SimulationContext, line: bytes, *, now: float) -> ResponseBuilder | Deferred:
    """Execute one request line at a time [s]; returns what builds the response."""
    try:
        request = json.loads(line)
        if not isinstance(request, dict):
            raise InputError("a line must be a JSON object")
        op = request.get("op")
        if not isinstance(op, str) or op not in _OPERATIONS:
            raise InputError(f"op must be one of {', '.join(_OPERATIONS)}, got {str(op)[:40]!r}")
        result = _OPERATIONS[op](context, request, now)
    except (json.JSONDecodeError, UnicodeDecodeError, RecursionError) as error:
        return ready({"error": f"invalid JSON: {error}"})
    except (InputError, OSError) as error:
        return ready({"error": _message(error)})
    return result if isinstance(result, Deferred) else lambda: _build(result)


def _build(builder: ResponseBuilder) -> Response:
    try:
        return builder()
    except (InputError, OSError) as error:
        return {"error": _message(error)}


def _message(error: InputError | OSError) -> str:
    """The message of an error, without the errno of one about a file."""
    if isinstance(error, OSError) and error.strerror:
        return f"{error.filename or 'file'}: cannot be written: {error.strerror}"
    return str(error)


def _hello(context: SimulationContext, request: Request, now: float) -> ResponseBuilder:
    return ready(
        {
            "protocol": "era-sim-control",
            "version": VERSION,
            "clock": "wall" if context.step is None else "virtual",
            "ops": list(_OPERATIONS),
            "urls": dict(context.urls),
        }
    )


def _state(context: SimulationContext, request: Request, now: float) -> ResponseBuilder:
    bench = context.bench
    bench.advance(now)
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
    resting = {name: list(position) for name, position in bench.fingers.layout.positions.items()}
    return ready({"time_s": bench.time, "fingers": resting, "amplifiers": amplifiers})


def _step(context: SimulationContext, request: Request, now: float) -> Deferred:
    seconds, step = parse_number(request, "seconds", "seconds"), context.step
    if step is None:
        raise InputError("step needs virtual time: start era sim with --virtual-time")
    if not 0 < seconds <= _MAX_STEP:
        raise InputError(f"seconds must be above 0 and at most {_MAX_STEP:g}, got {seconds:g}")

    async def wait() -> None:
        await step(seconds)
        context.bench.advance(now + seconds)

    return Deferred(wait, lambda: {"ok": True, "time_s": context.bench.time})


_OPERATIONS: Mapping[str, Operation] = {
    "hello": _hello,
    "state": _state,
    **finger_operations.OPERATIONS,
    **sensor_operations.OPERATIONS,
    **fault_operations.OPERATIONS,
    "step": _step,
}

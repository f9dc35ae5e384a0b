"""Operations of the control socket, version 3: one JSON object per line in each direction.

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

    sensors
    {"op": "sensors", "sensors": {NAME: {"at_m": [x, y], "noise_m_s2_rthz", "reach_m_s2",
                                         "resolution_m_s2", "scale"}}}
                                                       replace all sensors; only at_m is required
    {"op": "signals", "since_s": t0, "until_s": t1}    {"sample_rate_hz", "start_s",
                                                        "sensors": {NAME: {"at_m", "m_s2": [...]}}}
    {"op": "tones", "since_s", "until_s", "frequencies_hz": [f, ...]}
        {"sensors": {NAME: {"at_m", "real_m_s2": [one per frequency], "imag_m_s2": [...]}}}
        least squares over the signals; Im[a exp(i omega t)], t on the simulation's clock

    {"op": "plate", "modulus": factor, "stiffness": {ERA: factor}, "masses": [[x, y, kg], ...]}
                                               change the plate as it was at first, at rest; a key
                                               left out is as at first: {"ok": true, "time_s"}

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
import math
from collections.abc import Mapping

from model.errors import InputError
from sim.control.context import SimulationContext
from sim.control.plate_operations import OPERATIONS, Operation, Response
from sim.control.requests import Request, Step, read
from sim.faults.fault_window import parse_fault

VERSION = 3


async def carry_out(context: SimulationContext, line: bytes, *, now: float) -> Response:
    """Execute one request line at a time [s]."""
    try:
        request = json.loads(line)
        if not isinstance(request, dict):
            raise InputError("a line must be a JSON object")
        op = request.get("op")
        if not isinstance(op, str) or op not in _OPERATIONS:
            raise InputError(f"op must be one of {', '.join(_OPERATIONS)}, got {str(op)[:40]!r}")
        return await _OPERATIONS[op](context, request, now)
    except (json.JSONDecodeError, UnicodeDecodeError, RecursionError) as error:
        return {"error": f"invalid JSON: {error}"}
    except InputError as error:
        return {"error": str(error)}
    except OSError as error:
        problem = f"{error.filename or 'file'}: cannot be written: {error.strerror}"
        return {"error": problem if error.strerror else str(error)}


async def _hello(context: SimulationContext, request: Request, now: float) -> Response:
    return {
        "protocol": "era-sim-control",
        "version": VERSION,
        "clock": "wall" if context.step is None else "virtual",
        "ops": list(_OPERATIONS),
        "urls": dict(context.urls),
    }


async def _state(context: SimulationContext, request: Request, now: float) -> Response:
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


async def _inject_fault(context: SimulationContext, request: Request, now: float) -> Response:
    window = parse_fault({key: value for key, value in request.items() if key != "op"})
    for device in context.devices_of(window.amplifier):
        device.inject_fault(window)
    return {"ok": True, "time_s": now}


async def _faults(context: SimulationContext, request: Request, now: float) -> Response:
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


async def _recover(context: SimulationContext, request: Request, now: float) -> Response:
    for device in context.devices_of(request.get("amplifier")):
        device.recover()
    return {"ok": True, "time_s": now}


async def _step(context: SimulationContext, request: Request, now: float) -> Response:
    seconds = read(Step, request).seconds
    if context.step is None:
        raise InputError("step needs virtual time: start era sim with --virtual-time")
    await context.step(seconds)
    context.bench.advance(now + seconds)
    return {"ok": True, "time_s": context.bench.time}


_OPERATIONS: Mapping[str, Operation] = {
    "hello": _hello,
    "state": _state,
    **OPERATIONS,
    "inject_fault": _inject_fault,
    "faults": _faults,
    "recover": _recover,
    "step": _step,
}

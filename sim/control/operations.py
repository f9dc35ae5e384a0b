"""What the control socket of a far end takes: version 2 of its lines.

    {"op": "hello"}                            {"protocol": "era-sim-control", "version": 2,
                                                "clock": "wall" or "virtual", "ops": [...],
                                                "urls": {NAME: URL}}
    {"op": "state"}                            {"time_s": t, "fingers": {ID: [x, y]},
                                                "amplifiers": {NAME: {"state", "fault", "token",
                                                "high_voltage", "levels"}}}

    fingers, their places [x, y] in metres
    {"op": "fingers", "fingers": {ID: [x, y]}} these rest there, no others: {"ok": true, "time_s"}
    {"op": "come", "finger": ID, "at_m": [x, y]}       one more; "move": one that is there;
    {"op": "go", "finger": ID}                         lifted
    {"op": "felt", "since_s": t0, "until_s": t1}
        {"fingers": {ID: {"points_m": [[x, y], ...], "frequencies_hz": [f, ...],
                          "amplitude_m_s2": [[one per point], one row per frequency],
                          "peak_m_s2": [one per point]}}}

    sensors
    {"op": "sensors", "sensors": {NAME: {"at_m": [x, y], "noise_m_s2_rthz", "reach_m_s2",
                                         "resolution_m_s2", "scale"}}}
                                                       all but at_m may be left out; no others stay
    {"op": "signals", "since_s": t0, "until_s": t1}    {"sample_rate_hz", "start_s",
                                                        "sensors": {NAME: {"at_m", "m_s2": [...]}}}
    {"op": "tones", "since_s", "until_s", "frequencies_hz": [f, ...]}
        {"sensors": {NAME: {"at_m", "real_m_s2": [one per frequency], "imag_m_s2": [...]}}}
        by least squares over the signals; Im[a exp(i omega t)], t the far end's time

    {"op": "inject_fault", "fault": ..., "lasts": ..., ...}  a fault as in a fault file, from now on
    {"op": "faults"}                                   {"faults": {NAME: [{"fault", "begin_s",
                                                           "end_s" or null, "is_on"}]}}
    {"op": "recover", "amplifier": NAME}               every fault ends; without a name, of all
    {"op": "step", "seconds": s}                       lets virtual time pass: {"time_s": t}
    {"op": "record", "file": PATH}                     sensors and fingers that are there now
    {"op": "finish"}                                   writes it: {"file", "seconds", "is_full"}

Times are the far end's [s]: time.monotonic(), or the virtual clock, which begins at 0. Of felt,
signals and tones the last ten seconds can be had. What is wrong gets {"error": TEXT} and changes
nothing.
"""

import json
from collections.abc import Mapping
from typing import Any

from model.errors import InputError
from sim.control import faults, fingers, sensors
from sim.control.answers import Answer, Operation, Wait, already
from sim.control.context import SimulationContext
from sim.control.values import number_of

VERSION = 2
_STEP_MAX = 3600.0  # s of virtual time in one request


def carry_out(context: SimulationContext, line: bytes, *, now: float) -> Answer | Wait:
    """Do what one line of control asks now [s]; returns what makes the answer to it.

    Making it may take long and touches nothing of the bench any more: any thread may do it.
    """
    try:
        request = json.loads(line)
        if not isinstance(request, dict):
            raise InputError("a line must be a JSON object")
        op = request.get("op")
        if not isinstance(op, str) or op not in _OPS:
            raise InputError(f"op is {str(op)[:40]!r}; it must be one of {', '.join(_OPS)}")
        made = _OPS[op](context, request, now)
    except (json.JSONDecodeError, UnicodeDecodeError, RecursionError) as error:
        return already({"error": f"not a line of JSON: {error}"})
    except (InputError, OSError) as error:
        return already({"error": _in_words(error)})
    return made if isinstance(made, Wait) else lambda: _made(made)


def _made(answer: Answer) -> dict[str, Any]:
    try:
        return answer()
    except (InputError, OSError) as error:
        return {"error": _in_words(error)}


def _in_words(error: InputError | OSError) -> str:
    """What the system says of a file, without its number for it."""
    if isinstance(error, OSError) and error.strerror:
        return f"{error.filename or 'the file'} cannot be written: {error.strerror}"
    return str(error)


def _hello(context: SimulationContext, request: dict[str, Any], now: float) -> Answer:
    return already(
        {
            "protocol": "era-sim-control",
            "version": VERSION,
            "clock": "wall" if context.step is None else "virtual",
            "ops": list(_OPS),
            "urls": dict(context.urls),
        }
    )


def _state(context: SimulationContext, request: dict[str, Any], now: float) -> Answer:
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
    resting = {name: list(place) for name, place in bench.fingers.layout.positions.items()}
    return already({"time_s": bench.time, "fingers": resting, "amplifiers": amplifiers})


def _step(context: SimulationContext, request: dict[str, Any], now: float) -> Wait:
    seconds, step = number_of(request, "seconds", "seconds"), context.step
    if step is None:
        raise InputError("time is the clock's here; start the far end with --virtual-time")
    if not 0 < seconds <= _STEP_MAX:
        raise InputError(f"seconds is {seconds:g}; it must lie between 0 and {_STEP_MAX:g}")

    async def passes() -> None:
        await step(seconds)
        context.bench.advance(now + seconds)

    return Wait(passes, lambda: {"ok": True, "time_s": context.bench.time})


_OPS: Mapping[str, Operation] = {
    "hello": _hello,
    "state": _state,
    **fingers.OPERATIONS,
    **sensors.OPERATIONS,
    **faults.OPERATIONS,
    "step": _step,
}

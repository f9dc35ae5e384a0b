"""Operations of control on faults: what befalls amplifiers and their wires, and when it is over."""

import math
from collections.abc import Mapping
from typing import Any

from sim.control.answers import Answer, Operation, already
from sim.control.context import SimulationContext
from sim.faults.fault_file import parse_fault


def _inject_fault(context: SimulationContext, request: dict[str, Any], now: float) -> Answer:
    told = {key: value for key, value in request.items() if key != "op"}
    window = parse_fault(told)
    for device in context.devices_of(window.amplifier):
        device.inject_fault(window)
    return already({"ok": True, "time_s": now})


def _faults(context: SimulationContext, request: dict[str, Any], now: float) -> Answer:
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
    return already({"faults": listed})


def _recover(context: SimulationContext, request: dict[str, Any], now: float) -> Answer:
    for device in context.devices_of(request.get("amplifier")):
        device.recover()
    return already({"ok": True, "time_s": now})


OPERATIONS: Mapping[str, Operation] = {
    "inject_fault": _inject_fault,
    "faults": _faults,
    "recover": _recover,
}

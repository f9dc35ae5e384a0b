"""Control operations on faults."""

import math
from collections.abc import Mapping

from sim.control.context import SimulationContext
from sim.control.responses import Operation, Request, ResponseBuilder, ready
from sim.faults.fault_file import parse_fault


def _inject_fault(context: SimulationContext, request: Request, now: float) -> ResponseBuilder:
    window = parse_fault({key: value for key, value in request.items() if key != "op"})
    for device in context.devices_of(window.amplifier):
        device.inject_fault(window)
    return ready({"ok": True, "time_s": now})


def _faults(context: SimulationContext, request: Request, now: float) -> ResponseBuilder:
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
    return ready({"faults": listed})


def _recover(context: SimulationContext, request: Request, now: float) -> ResponseBuilder:
    for device in context.devices_of(request.get("amplifier")):
        device.recover()
    return ready({"ok": True, "time_s": now})


OPERATIONS: Mapping[str, Operation] = {
    "inject_fault": _inject_fault,
    "faults": _faults,
    "recover": _recover,
}

"""Every frame of every wire in the trace: both directions, bytes and meaning."""

from contextlib import suppress
from pathlib import Path

import pytest

from drivers import trace
from drivers.amplifier import Amplifier
from drivers.errors import LinkError
from drivers.operation.silence import stop_and_confirm
from drivers.protocol.messages import AmplifierState
from drivers.registry import open_backend
from drivers.trace import tracing
from memory_machine import live_in_memory
from model.rig.rig import Rig
from sim.faults.fault_window import FaultWindow
from virtual_loop import in_virtual_time
from wires import WIRES, far_side

# Frames of a Stop with a ramp of 5 ms and of its reply, by the pages of the wires.
STOPS = {
    "serial": "Stop(ramp=0.005)",
    "modbus+tcp": "unit 1, function 23",
    "modbus+rtu": "unit 1, function 23",
    "can+socketcand": "order node 1 {'token': 0, 'ramp': 5",
    "can+slcan": "order node 1 {'token': 0, 'ramp': 5",
}


@pytest.mark.parametrize("wire", WIRES)
@in_virtual_time
async def test_wire_traces_a_stop_and_its_reply(wire: str, coarse_rig: Rig, tmp_path: Path) -> None:
    """Bytes in hexadecimal and what they mean; nothing is undecodable."""
    path = tmp_path / "trace.txt"
    live_in_memory()
    async with far_side(WIRES[wire], coarse_rig) as far:
        amplifier = Amplifier(open_backend(far.url))
        await amplifier.open()
        with tracing(path):
            await amplifier.stop()
            await amplifier.status()
        await amplifier.close()
    lines = [line for line in path.read_text("utf-8").splitlines() if " wire " in line]
    sent = [line for line in lines if " > " in line]
    received = [line for line in lines if " < " in line]
    assert STOPS[wire] in sent[0]
    assert len(sent) >= 2
    answer = "answer node 1" if wire.startswith("can") else "QUICK_STOP_ACTIVE"
    assert wire.startswith("modbus") or any(answer in line for line in received)
    assert len(received) >= 2
    assert not any("not decoded" in line or "unknown" in line for line in lines)


@pytest.mark.parametrize("wire", WIRES)
@in_virtual_time
async def test_stop_is_sent_although_tracing_fails(
    wire: str, coarse_rig: Rig, monkeypatch: pytest.MonkeyPatch
) -> None:
    """An exception of the trace costs at most the reply."""

    def fail(*_: object) -> None:
        raise MemoryError

    live_in_memory()
    async with far_side(WIRES[wire], coarse_rig) as far:
        amplifier = Amplifier(open_backend(far.url))
        await amplifier.open()
        monkeypatch.setattr(trace, "frame", fail)
        monkeypatch.setattr(trace, "is_active", lambda: True)
        await stop_and_confirm(amplifier)
        assert far.amplifier.state is AmplifierState.QUICK_STOP_ACTIVE
        await amplifier.close()


@in_virtual_time
async def test_trace_has_damaged_serial_frames(coarse_rig: Rig, tmp_path: Path) -> None:
    """A reply with a wrong checksum, as its bytes arrived."""
    path = tmp_path / "trace.txt"
    live_in_memory()
    async with far_side(WIRES["serial"], coarse_rig) as far:
        amplifier = Amplifier(open_backend(far.url))
        await amplifier.open()
        far.device.inject_fault(FaultWindow("corrupt", toward="host"))
        with tracing(path), suppress(LinkError):
            await amplifier.status()
        await amplifier.close()
    received = [line for line in path.read_text("utf-8").splitlines() if " < " in line]
    assert received
    assert all(line.endswith("  damaged") for line in received)

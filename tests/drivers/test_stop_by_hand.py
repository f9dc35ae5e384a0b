"""`era amp stop` over every wire, at an amplifier that another host left playing."""

import re
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest
from controller.group.amplifier_group import AmplifierGroup
from controller.group.quick_stops import QuickStops

from drivers import amp_actions
from drivers.amplifier import Amplifier
from drivers.protocol.messages import AmplifierState, GetStatus, Reply, Request, Status, Stop
from drivers.registry import open_backend
from drivers.trace import tracing
from memory_machine import live_in_memory
from model.rig.rig import Rig
from sim.far_ends.wires import Wire
from virtual_loop import run_virtual
from wires import far_side, tones

KINDS = ["serial", "modbus-rtu", "modbus-tcp", "socketcand", "slcan"]


async def leave_playing(url: str) -> None:
    """Arm an amplifier and play, and close the wire."""
    earlier = Amplifier(open_backend(url))
    await earlier.open()
    await earlier.arm(2.0)
    await earlier.apply(tones(earlier, 0.5))
    await earlier.close()


@pytest.mark.parametrize("kind", KINDS)
def test_stop_is_sent_before_anything_is_read(kind: str, coarse_rig: Rig, tmp_path: Path) -> None:
    """Silent while it plays; identity, capabilities and status are read afterwards."""

    async def run() -> None:
        live_in_memory()
        async with far_side(Wire(kind), coarse_rig) as far:
            await leave_playing(far.url)
            with tracing(tmp_path / "trace"):
                result = await amp_actions.stop(far.url)
            assert (result["silence"], result["cause"]) == ("confirmed_silent", "")
            assert result["state"] == "QUICK_STOP_ACTIVE"
            assert far.amplifier.state is AmplifierState.QUICK_STOP_ACTIVE
            assert not any(far.amplifier.status(far.bench.time).levels)

    run_virtual(run())
    requests = re.findall(r" request (\w+)\(.*\) -> ", (tmp_path / "trace").read_text("utf-8"))
    assert requests[0] == "Stop"
    assert set(requests[1:]) >= {"Hello", "GetCaps", "GetStatus"}


@pytest.mark.parametrize("take_over", [True, False])
@pytest.mark.parametrize("kind", KINDS)
def test_opening_disarms_unless_the_caller_only_looks(
    kind: str, take_over: bool, coarse_rig: Rig
) -> None:
    """An earlier host has left it playing."""

    async def run() -> None:
        live_in_memory()
        async with far_side(Wire(kind), coarse_rig) as far:
            await leave_playing(far.url)
            amplifier = Amplifier(open_backend(far.url))
            await amplifier.open(take_over=take_over)
            status = await amplifier.status()
            disarmed = AmplifierState.SWITCH_ON_DISABLED
            assert status.state is (disarmed if take_over else AmplifierState.OPERATION_ENABLED)
            assert any(status.levels) is not take_over
            await amplifier.close()

    run_virtual(run())


def stale(status: Status) -> Status:
    """The reply to an earlier Stop, as a converter may have kept it."""
    return replace(
        status, state=AmplifierState.QUICK_STOP_ACTIVE, levels=(0.0,) * len(status.levels), latch=1
    )


def of_no_channel(status: Status) -> Status:
    """Stopped, with the level of no channel."""
    return replace(stale(status), levels=(), latch=status.latch + 1)


@pytest.mark.parametrize("whose", ["command", "group"])
@pytest.mark.parametrize("lie", [stale, of_no_channel])
@pytest.mark.parametrize("kind", KINDS)
def test_status_that_proves_nothing_confirms_no_silence(
    kind: str, lie: Callable[[Status], Status], whose: str, coarse_rig: Rig
) -> None:
    """It plays on, and says after each Stop what an earlier Status said, or nothing of channels."""

    async def run() -> None:
        live_in_memory()
        async with far_side(Wire(kind), coarse_rig) as far:
            group = AmplifierGroup({"main": Amplifier(open_backend(far.url))})
            await group.open()
            await group.stop()
            await group.clear()
            await group.close({})
            await leave_playing(far.url)
            true_exchange, true_status = far.device.exchange, far.device.status
            stops = 0

            def status() -> Status:
                return lie(replace(true_status(), latch=1 + stops)) if stops else true_status()

            def exchange(request: Request) -> Reply | None:
                nonlocal stops
                if isinstance(request, Stop):
                    stops += 1
                    return status()
                return status() if isinstance(request, GetStatus) else true_exchange(request)

            far.device.exchange = exchange  # type: ignore[method-assign]
            far.device.status = status  # type: ignore[method-assign]
            if whose == "command":
                assert (await amp_actions.stop(far.url))["silence"] != "confirmed_silent"
            else:
                amplifier = Amplifier(open_backend(far.url))
                await amplifier.open(take_over=False)
                await amplifier.status()
                outcome = (await QuickStops({"main": amplifier}).stop())["main"]
                assert not outcome.is_confirmed
                await amplifier.close()
            assert any(true_status().levels)

    run_virtual(run())

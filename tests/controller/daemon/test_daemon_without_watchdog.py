"""A daemon over an amplifier of class C: refused, or driven under supervision and shown."""

from dataclasses import replace
from pathlib import Path

import pytest

from controller.cli.daemon import show_status
from daemon_bench import daemon_at, far_end, until_state
from drivers.errors import CommandError
from drivers.protocol.messages import Feature
from sim.faults.fault_window import FaultWindow
from wires import FarSide

READY = "READY_TO_SWITCH_ON"


def take_watchdog(far: FarSide) -> None:
    """Let the amplifier have no watchdog, from its next restart on."""
    able = far.amplifier.capabilities
    far.amplifier.capabilities = replace(able, features=able.features & ~Feature.WATCHDOG)
    far.device.restart()


async def test_daemon_refuses_an_amplifier_without_watchdog(tmp_path: Path) -> None:
    """It ends, and the amplifier stays disarmed."""
    async with far_end(tmp_path) as far:
        take_watchdog(far)
        with pytest.raises(CommandError, match="supervised: true"):
            async with daemon_at(far, tmp_path) as bench, await bench.client() as era:
                await until_state(era, READY)
        assert not any(far.device.status().levels)


async def test_supervised_daemon_shows_class_c_and_assumes_it_plays_on(tmp_path: Path) -> None:
    """In the status, also of a lost one: no time ends it."""
    async with far_end(tmp_path) as far:
        take_watchdog(far)
        async with (
            daemon_at(far, tmp_path, "supervised: true\n") as bench,
            await bench.client() as era,
        ):
            await until_state(era, READY)
            status = await era.status()
            assert [one.amplifier_class for one in status.amplifiers] == ["C"]
            assert (status.watchdog_s, status.assume_energised) == (None, False)
            assert "CLASS C" in show_status(status)
            await era.arm("me", lease_s=30)
            far.device.inject_fault(FaultWindow("hang"))
            await until_state(era, "COMM_LOST")
            bench.daemon._supervisor.machine = replace(
                bench.daemon._supervisor.machine, lost_at=-1e6
            )
            lost = await era.status()
            assert lost.assume_energised
            assert "plays on until it is switched off" in show_status(lost)
            far.device.recover()

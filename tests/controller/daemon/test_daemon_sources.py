"""Several touch sources of a daemon at once, each with its own calibration."""

import asyncio
import socket
from pathlib import Path

import pytest

from controller.sources.touch import Touch, TouchFrame
from controller.sources.tuio import tuio_datagram
from daemon_bench import running_daemon, until_state
from sim.faults.fault_window import FaultWindow


def free_port() -> int:
    """A UDP port that nobody holds just now."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as free:
        free.bind(("127.0.0.1", 0))
        return int(free.getsockname()[1])


async def test_two_panels_and_a_program(tmp_path: Path) -> None:
    """Their fingers are one set on the plate of 0.3048 m by 0.2286 m: one is felt, two are quiet.

    The same touch of the panel that is mounted upside down lies at the opposite place.
    """
    one, two = free_port(), free_port()
    more = (
        "touch:\n"
        f'  - {{name: left, url: "tuio:127.0.0.1:{one}"}}\n'
        f'  - {{name: right, url: "tuio:127.0.0.1:{two}", calibration: {{turned: 180}}}}\n'
    )
    async with running_daemon(tmp_path, more) as bench, await bench.client() as era:
        await until_state(era, "READY_TO_SWITCH_ON")
        await era.arm("me", lease_s=60)
        found: dict[str, tuple[float, float]] = {}
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender:
            for number in range(1, 2000):
                for port in (one, two):
                    frame = TouchFrame("panel", 0.0, (Touch(1, 0.25, 0.25),))
                    sender.sendto(tuio_datagram(frame, number), ("127.0.0.1", port))
                await era.touch([(0.15, 0.1)])
                await asyncio.sleep(0.02)
                status = await era.status()
                roles = sorted(contact.role or "" for contact in status.contacts)
                if roles == ["quiet", "quiet", "target"]:
                    found = {
                        contact.source.partition(":")[0]: (contact.x_m, contact.y_m)
                        for contact in status.contacts
                    }
                    break
        assert found == {
            "left": pytest.approx((0.0762, 0.17145)),
            "right": pytest.approx((0.2286, 0.05715)),
            "api": pytest.approx((0.15, 0.1)),
        }


async def test_a_finger_that_lifts_while_the_link_is_lost(tmp_path: Path) -> None:
    """Nobody follows it meanwhile, so it is not shown, nor is it there when the link is back."""
    async with running_daemon(tmp_path) as bench, await bench.client() as era:
        await until_state(era, "READY_TO_SWITCH_ON")
        await era.touch([(0.1, 0.1)])
        await asyncio.sleep(0.05)
        assert len((await era.status()).contacts) == 1
        await era.touch([(0.1, 0.1)])
        bench.far.device.inject_fault(FaultWindow("hang"))
        while (await era.status()).state != "COMM_LOST":
            await era.touch([(0.1, 0.1)])
            await asyncio.sleep(0.03)
        await era.touch([])
        assert (await era.status()).contacts == []
        bench.far.device.recover()
        await until_state(era, "READY_TO_SWITCH_ON")
        assert (await era.status()).contacts == []

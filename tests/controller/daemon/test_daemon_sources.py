"""Several touch sources of a daemon at once, each with its own calibration."""

import asyncio
import socket
from pathlib import Path

import pytest

from controller.sources.touch import Touch, TouchFrame
from controller.sources.tuio import tuio_datagram
from daemon_bench import ready_daemon
from tuio_panel import free_port


async def test_daemon_combines_contacts_of_panels_and_clients(tmp_path: Path) -> None:
    """One is the target, two are quiet; each lies where its source's calibration puts it.

    The plate is 0.3048 m by 0.2286 m, TUIO counts downwards, and one panel is upside down.
    """
    one, two = free_port(), free_port()
    more = (
        "touch:\n"
        f'  - {{name: left, url: "tuio:127.0.0.1:{one}"}}\n'
        f'  - {{name: right, url: "tuio:127.0.0.1:{two}", calibration: {{turned: 180}}}}\n'
    )
    async with ready_daemon(tmp_path, more) as (_, era):
        await era.arm("me", lease_s=60)
        found: dict[tuple[str, int], tuple[float, float]] = {}
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender:
            for number in range(1, 2000):
                for port in (one, two):
                    frame = TouchFrame("panel", 0.0, (Touch(7, 0.25, 0.25),))
                    sender.sendto(tuio_datagram(frame, number), ("127.0.0.1", port))
                await era.touch([(0.15, 0.1)])
                await asyncio.sleep(0.02)
                contacts = (await era.status()).contacts
                if sorted(each.role or "" for each in contacts) == ["quiet", "quiet", "target"]:
                    found = {
                        (each.source.partition(":")[0], each.id): (each.x_m, each.y_m)
                        for each in contacts
                    }
                    break
        assert found == {
            ("left", 7): pytest.approx((0.0762, 0.17145)),
            ("right", 7): pytest.approx((0.2286, 0.05715)),
            ("api", 1): pytest.approx((0.15, 0.1)),
        }

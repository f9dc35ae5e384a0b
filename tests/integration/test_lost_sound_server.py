"""A sound server that is killed while the daemon plays through a software amplifier.

Its short form has no daemon: tests/sim/desk/soft_amp/test_soft_amp_sound.py.
"""

import asyncio
import os
import time
from pathlib import Path
from types import SimpleNamespace

import pytest

from controller.api.client import AsyncClient
from daemons import PATIENCE, PLACE, READY, daemon_at, holding, ready, until, until_state
from patient_daemon import wait_long
from sound_cards import SoftAmp, capture_on, jack_server

pytestmark = [
    pytest.mark.long,
    pytest.mark.alone,
    pytest.mark.needs("jackd", "cc"),
]

CHANNELS = 4
SERVER_BACK = 20.0  # s


async def test_lost_server_is_a_fault_and_comes_back_disarmed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The daemon is in fault or has lost it; once the server is back, the device opens, and waits.

    For arm, although the finger has never left.
    """
    wait_long(monkeypatch)
    name = f"gone{os.getpid()}"
    with jack_server(name, outputs=CHANNELS) as server:
        capture_on(name, "looking", 1).close()  # once the server is up
        options = ("--device", "jack", "--channels", str(CHANNELS), "--link", str(tmp_path / "amp"))
        amp = SoftAmp(*options, environment=server.environment, log=tmp_path / "log")
        far = SimpleNamespace(urls={})
        change = ('main: {url: "sim://"}', f'main: {{url: "{amp.url}", full_level: output}}')
        async with (
            daemon_at(far, tmp_path, changes=(change,)) as daemon,
            await daemon.client() as era,
            holding(era, PLACE),
        ):
            await ready(era)
            await era.arm("test", lease_s=60)
            await _until_playing(era)
            server.process.kill()
            server.process.wait()
            await until_state(era, "FAULT", "COMM_LOST")
            assert not (await era.status()).drive
            with jack_server(name, outputs=CHANNELS):
                await until(lambda: "open again" in amp.log, patience=SERVER_BACK)
                await until_state(era, "FAULT", "COMM_LOST", READY)
                assert not (await era.status()).drive
                await ready(era)
                await era.arm("test", lease_s=60)
                await _until_playing(era)
        amp.end()


async def _until_playing(era: AsyncClient) -> None:
    end = time.monotonic() + PATIENCE
    while not (await era.status()).drive:
        assert time.monotonic() < end
        await asyncio.sleep(0.01)

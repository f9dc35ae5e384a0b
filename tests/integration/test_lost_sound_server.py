"""A daemon on a software amplifier whose sound server dies."""

import asyncio
import os
import signal
import time
from collections.abc import Sequence
from pathlib import Path
from types import SimpleNamespace

import pytest

from controller.api.client import AsyncClient
from processes.daemons import (
    PATIENCE,
    PLACE,
    READY,
    daemon_at,
    holding,
    ready,
    until_state,
)
from processes.jack_recorder import Capture
from processes.patient_daemon import wait_long
from processes.sound_cards import SoftAmp, jack_server

CHANNELS = 4
SERVER_BACK = 20.0  # s


@pytest.mark.long
@pytest.mark.alone
@pytest.mark.needs("jackd", "portaudio", "cc")
async def test_lost_server_is_a_fault_and_comes_back_disarmed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The daemon loses the amplifier; once server and amplifier are back, it waits for arm.

    The finger never leaves. A service manager would restart the amplifier; the test does.
    """
    wait_long(monkeypatch)
    name = f"gone{os.getpid()}"
    with jack_server(name, outputs=CHANNELS) as server:
        options = ("--device", "system, JACK", "--channels", str(CHANNELS))
        amp = _soft_amp(options, name, tmp_path)
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
            ended = await asyncio.to_thread(amp.process.wait, SERVER_BACK)
            assert ended in {3, -signal.SIGKILL}  # by itself, or by the kernel
            amp.end()
            with jack_server(name, outputs=CHANNELS):
                amp = _soft_amp(options, name, tmp_path)
                await until_state(era, "FAULT", "COMM_LOST", READY)
                assert not (await era.status()).drive
                await ready(era)
                await era.arm("test", lease_s=60)
                await _until_playing(era)
                amp.end()


def _soft_amp(options: Sequence[str], server: str, folder: Path) -> SoftAmp:
    """Start it as soon as the server is up."""
    Capture(server, "looking", 1).close()
    environment = os.environ | {"JACK_DEFAULT_SERVER": server}
    link = ("--link", str(folder / "amp"))
    return SoftAmp(*options, *link, environment=environment, log=folder / "log")


async def _until_playing(era: AsyncClient) -> None:
    end = time.monotonic() + PATIENCE
    while not (await era.status()).drive:
        assert time.monotonic() < end
        await asyncio.sleep(0.01)

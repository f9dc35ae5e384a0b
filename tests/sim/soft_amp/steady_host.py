"""A host that plays 1 kHz at level 0.5 on every channel of a linear amplifier, until killed.

    python tests/sim/soft_amp/steady_host.py URL CHANNELS

Each channel is 30 degrees ahead of the one before. It prints `armed`. The amplifier waits for it as
long as the protocol allows, and after a longer stall of the machine it plays again.
"""

import asyncio
import contextlib
import os
import signal
import subprocess
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path

import pytest

from drivers.errors import CommandRefused, LinkError
from drivers.host.amplifier import Amplifier
from drivers.host.group import Group
from drivers.opening import Lines
from drivers.playing import AmplifierLayer, AmplifierTone
from drivers.protocol.definition import QUANTITIES
from processes.patient_daemon import wait_long
from registry.limits import GuardLimits

LIMITS = GuardLimits(40, 1000, 1.0)
WATCHDOG = QUANTITIES["watchdog"].high  # s
_BEAT = 0.1  # s
_SUPPORT = Path(__file__).parents[2] / "support"


async def linear_amplifier(lines: Lines, url: str) -> Amplifier:
    """The amplifier of a URL, whose full level is its output; nothing is sent."""
    return await lines.amplifier(url, LIMITS, name="a", is_output=True)


async def main(url: str, channels: int) -> None:
    """Acknowledge a fault, arm and play."""
    amplifier = await linear_amplifier(Lines(), url)
    group = Group({"a": amplifier}, watchdog=WATCHDOG)
    tones = [AmplifierTone(n, 1000.0, 0.5, (30.0 * n + 180) % 360 - 180) for n in range(channels)]
    while True:
        try:
            await _play(group, tones)
        except (CommandRefused, LinkError):
            await asyncio.sleep(_BEAT)


async def _play(group: Group, tones: Sequence[AmplifierTone]) -> None:
    await group.open()
    await group.clear()
    await group.arm()
    sys.stdout.write("armed\n")
    sys.stdout.flush()
    await group.apply({"a": [AmplifierLayer(0, tuple(tones))]})
    while True:
        await group.beat()
        await asyncio.sleep(_BEAT)


@contextlib.contextmanager
def playing_host(url: str, channels: int) -> Iterator["subprocess.Popen[str]"]:
    """A program that plays 1 kHz at level 0.5 on every channel, each 30 degrees ahead."""
    with subprocess.Popen(
        [sys.executable, __file__, url, str(channels)],
        stdout=subprocess.PIPE,
        stderr=subprocess.DEVNULL,
        text=True,
        env=os.environ | {"PYTHONPATH": str(_SUPPORT)},
    ) as process:
        assert process.stdout.readline() == "armed\n"
        yield process
        with contextlib.suppress(ProcessLookupError):
            process.send_signal(signal.SIGKILL)


if __name__ == "__main__":
    wait_long(pytest.MonkeyPatch())
    asyncio.run(main(sys.argv[1], int(sys.argv[2])))

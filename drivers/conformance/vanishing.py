"""The check of a host that vanishes: a process that arms the amplifier and plays is killed."""

import asyncio
import sys

from drivers import clock
from drivers.conformance.bench import Bench
from drivers.conformance.check import driving
from drivers.conformance.findings import NotApplicable, expect
from drivers.protocol.messages import AmplifierState, Fault, Feature

_WATCHDOG = 0.5  # s; long enough to open the line again
_PLAYING = 0.2  # s; before it is killed
_START_TIMEOUT = 20.0  # s
_HOST = "drivers.conformance.second_host"


@driving("wire-protocol.md#watchdog")
async def vanished_host(bench: Bench) -> None:
    """It falls silent by its own watchdog when the process of the host is killed."""
    bench.require(Feature.WATCHDOG)
    if not bench.url or bench.url.startswith("sim:"):
        raise NotApplicable("this amplifier is part of this process")
    watchdog = min(max(_WATCHDOG, bench.can.watchdog_min), bench.can.watchdog_max)
    amplifier = bench.amplifier
    await amplifier.close()
    try:
        killed_at = await _killed(bench.url, watchdog)
    finally:
        await amplifier.open(take_over=False)
    last_awake = -1.0
    while True:
        sample = await bench.sample()
        status = sample.status
        if status.state is not AmplifierState.OPERATION_ENABLED and not any(status.levels):
            break
        last_awake = sample.when.earliest - killed_at
        expect(
            last_awake <= watchdog + 0.01 + 2 * bench.exchange_time,
            "output after the host was killed",
            expected=f"silent within {watchdog + 0.01:.3f} s",
            seen=f"{status.state.name}, levels {status.levels} after {last_awake:.3f} s",
        )
        await asyncio.sleep(0.002)
    sample = await bench.sample()
    found = (sample.status.state.name, sample.status.fault.name)
    expect(
        found == (AmplifierState.FAULT.name, Fault.WATCHDOG.name),
        "state and fault, read from a new process, after the host was killed",
        expected="FAULT, WATCHDOG",
        seen=", ".join(found),
    )


async def _killed(url: str, watchdog: float) -> float:
    """Let another process arm and play, and kill it; returns when [s]."""
    process = await asyncio.create_subprocess_exec(
        sys.executable, "-m", _HOST, url, f"{watchdog:g}", stdout=asyncio.subprocess.PIPE
    )
    try:
        assert process.stdout is not None  # noqa: S101  it is a pipe
        async with asyncio.timeout(_START_TIMEOUT):
            said = await process.stdout.readline()
        expect(
            said.strip() == b"armed", "second host", expected="armed", seen=said.decode() or "no"
        )
        await asyncio.sleep(_PLAYING)
    finally:
        if process.returncode is None:
            process.kill()
        await process.wait()
    return clock.now()

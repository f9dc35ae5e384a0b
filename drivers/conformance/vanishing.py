"""The check of a host that vanishes: a process that arms the amplifier and plays is killed."""

import asyncio
import sys

from drivers import clock
from drivers.conformance.bench import Bench
from drivers.conformance.check import driving
from drivers.conformance.findings import ContractViolation, Inconclusive, NotApplicable, expect
from drivers.protocol.messages import AmplifierState, Fault, Feature

_WATCHDOG = 0.5  # s; long enough to open the line again
_PLAYING = 0.2  # s; before it is killed
_CERTAIN = 0.5  # s; later than any delay of a busy machine
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
    last_awake, is_certain, late = -1.0, False, None
    while True:
        sample = await bench.sample()
        status = sample.status
        if status.state is not AmplifierState.OPERATION_ENABLED and not any(status.levels):
            break
        last_awake = sample.when.earliest - killed_at
        is_certain = last_awake > watchdog + _CERTAIN
        if is_certain or last_awake > watchdog + 0.01 + 2 * bench.exchange_time:
            late = status
        if is_certain:
            break
        await asyncio.sleep(0.002)
    if late is not None:
        raise ContractViolation(
            "output after the host was killed",
            expected=f"silent within {watchdog + 0.01:.3f} s",
            seen=f"{late.state.name}, levels {late.levels} after {last_awake:.3f} s",
            is_certain=is_certain,
        )
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
        *(sys.executable, "-m", _HOST, url, f"{watchdog:g}"),
        stdout=asyncio.subprocess.PIPE,
        stderr=asyncio.subprocess.PIPE,
    )
    try:
        assert process.stdout is not None  # noqa: S101  it is a pipe
        try:
            async with asyncio.timeout(_START_TIMEOUT):
                said = await process.stdout.readline()
        except TimeoutError:
            raise Inconclusive(f"no second host within {_START_TIMEOUT:g} s") from None
        if said.strip() != b"armed":
            *_, last = (await process.communicate())[1].decode().splitlines() or [""]
            raise ContractViolation("second host", expected="armed", seen=last)
        await asyncio.sleep(_PLAYING)
    finally:
        if process.returncode is None:
            process.kill()
        await process.wait()
    return clock.now()

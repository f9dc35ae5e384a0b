"""The far end as users start it, a process of its own, with its control socket at hand."""

import asyncio
import contextlib
import json
import signal
import sys
import tempfile
from collections.abc import AsyncIterator, Mapping
from contextlib import asynccontextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from drivers.host.amplifier import Amplifier
from drivers.opening import Lines
from drivers.playing import Layer, Tone
from model.rig.rig_file import example_rig_path
from registry.limits import GuardLimits

PATIENCE = 180  # s; for a loaded machine, not an expectation


@dataclass
class FarEndProcess:
    """What was started: the URL by the amplifier's name, and its streams."""

    urls: Mapping[str, str]
    control: Path
    process: asyncio.subprocess.Process
    reader: asyncio.StreamReader
    writer: asyncio.StreamWriter

    async def ask(self, op: str, **request: Any) -> dict[str, Any]:
        """One line of control and the answer to it, errors among them."""
        self.writer.write(json.dumps({"op": op, **request}).encode() + b"\n")
        line = await asyncio.wait_for(self.reader.readline(), PATIENCE)
        answer: dict[str, Any] = json.loads(line)
        return answer

    async def end(self, number: signal.Signals = signal.SIGTERM) -> tuple[int | None, str]:
        """Tell it to end; its exit status and what it still said on standard output."""
        self.process.send_signal(number)
        out, _ = await asyncio.wait_for(self.process.communicate(), PATIENCE)
        return self.process.returncode, out.decode()


@asynccontextmanager
async def far_end_process(rig: Path, *options: str) -> AsyncIterator[FarEndProcess]:
    """`era sim` of a rig file with these options; it ends with the context at the latest."""
    with tempfile.TemporaryDirectory() as folder:  # a short path, as sockets need
        control = Path(folder) / "control"
        process = await asyncio.create_subprocess_exec(
            *(sys.executable, "-P", "-m", "sim", str(rig), "--control", str(control), *options),
            stdin=asyncio.subprocess.DEVNULL,
            stdout=asyncio.subprocess.PIPE,
            cwd=example_rig_path().parent.parent,
        )
        try:
            assert process.stdout is not None
            line = (await asyncio.wait_for(process.stdout.readline(), PATIENCE)).decode()
            name, _, url = line.strip().partition(": ")
            reader, writer = await asyncio.open_unix_connection(control, limit=1 << 24)
            try:
                yield FarEndProcess({name: url}, control, process, reader, writer)
            finally:
                writer.close()
                with contextlib.suppress(ConnectionError):
                    await writer.wait_closed()
        finally:
            if process.returncode is None:
                process.kill()
                await process.wait()


SESSION = 9


@asynccontextmanager
async def playing(url: str, tone: Tone, *, watchdog: float) -> AsyncIterator[Amplifier]:
    """Open, arm and play without a ramp; watchdog [s]: of which it falls silent after this."""
    lines = Lines()
    try:
        amplifier = await lines.amplifier(url, GuardLimits(40, 500, 1), name=url)
        await amplifier.open()
        await amplifier.arm(SESSION, watchdog)
        await amplifier.stage(1, [Layer(0, (tone,), ramp=0.0)], now=True)
        yield amplifier
    finally:
        await lines.close()

"""`era daemon` as a process, listening for TUIO; it waits for a busy machine."""

import asyncio
import contextlib
import signal
import time
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from dataclasses import dataclass
from pathlib import Path

import patient_daemon
from controller.api.async_client import AsyncClient
from felt_chain import LEVEL_DB_SL
from heard import PATIENCE
from rig_files import write_rig
from tuio_panel import free_port


@dataclass
class RunningDaemon:
    """Serves, and is ready to be armed; port: where it listens for TUIO."""

    process: asyncio.subprocess.Process
    port: int
    client: AsyncClient
    log: list[str]

    async def end(self) -> int:
        """Tell it to end; its exit status."""
        self.process.send_signal(signal.SIGTERM)
        return await asyncio.wait_for(self.process.wait(), PATIENCE)


@asynccontextmanager
async def running_daemon(folder: Path, url: str, *, table: Path) -> AsyncIterator[RunningDaemon]:
    """`era daemon` over this URL, ready to be armed; killed with the context at the latest."""
    write_rig(folder / "rig.yaml", ('main: {url: "sim://"}', f'main: {{url: "{url}"}}'))
    port = free_port()
    config = folder / "daemon.yaml"
    config.write_text(
        f"rig: rig.yaml\ntable: {table}\nsocket: era.sock\nlevel_db_sl: {LEVEL_DB_SL}\n"
        f'touch:\n  - {{name: panel, url: "tuio:127.0.0.1:{port}?timeout=60"}}\n',
        encoding="utf-8",
    )
    process = await asyncio.create_subprocess_exec(
        *(*patient_daemon.PROGRAM, "daemon", config),
        stdin=asyncio.subprocess.DEVNULL,
        stderr=asyncio.subprocess.PIPE,
    )
    log: list[str] = []
    assert process.stderr is not None
    reading = asyncio.create_task(_read(process.stderr, log))
    try:
        end = time.monotonic() + PATIENCE
        while not (folder / "era.sock").is_socket():
            assert process.returncode is None, (process.returncode, log)
            assert time.monotonic() < end, log
            await asyncio.sleep(0.02)
        client = await AsyncClient.connect(folder / "era.sock", name="test", timeout=PATIENCE)
        while (await client.status()).state != "READY_TO_SWITCH_ON":
            assert time.monotonic() < end, log
            await asyncio.sleep(0.02)
        yield RunningDaemon(process, port, client, log)
    finally:
        with contextlib.suppress(ProcessLookupError):
            process.kill()
        await process.wait()
        await reading


async def _read(stream: asyncio.StreamReader, log: list[str]) -> None:
    while line := await stream.readline():
        log.append(line.decode())

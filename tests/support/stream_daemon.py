"""`era daemon` as users run it, listening for TUIO, and with a bug planted in it."""

import asyncio
import contextlib
import signal
import socket
import sys
import time
from collections.abc import AsyncIterator, Mapping, Sequence
from contextlib import asynccontextmanager
from dataclasses import dataclass
from pathlib import Path

import planted_daemon
from controller.api.async_client import AsyncClient
from heard import PATIENCE
from rig_files import write_rig

ERA = Path(sys.executable).with_name("era")
LEVEL_DB_SL = 30.0


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
async def running_daemon(
    folder: Path,
    urls: Mapping[str, str],
    rig_changes: Sequence[tuple[str, str]],
    *,
    table: Path,
    drive_mode: str | None,
    bug: str | None,
) -> AsyncIterator[RunningDaemon]:
    """`era daemon` over these URLs; killed with the context at the latest.

    rig_changes: in the text of its rig; bug: planted in it.
    """
    reached = [
        (f'{name}: {{url: "sim://"}}', f'{name}: {{url: "{url}"}}') for name, url in urls.items()
    ]
    write_rig(folder / "rig.yaml", *rig_changes, *reached)
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    config = folder / "daemon.yaml"
    config.write_text(
        f"rig: rig.yaml\ntable: {table}\nsocket: era.sock\nlevel_db_sl: {LEVEL_DB_SL}\n"
        "touch_wait: 60 ms\n"  # not the default: the machine is busy with tests
        f'touch:\n  - {{name: panel, url: "tuio:127.0.0.1:{port}"}}\n'
        + (f"mode: {drive_mode}\n" if drive_mode else ""),
        encoding="utf-8",
    )
    command = (ERA,) if bug is None else (sys.executable, planted_daemon.__file__, bug)
    process = await asyncio.create_subprocess_exec(
        *(*command, "daemon", config),
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

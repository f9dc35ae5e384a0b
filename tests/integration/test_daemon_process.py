"""`era daemon` as a process over a pseudo-terminal: commands, locks, notices, children."""

import asyncio
import contextlib
import signal
import socket
import sys
from pathlib import Path

import httpx
import pytest

from controller.api.async_client import AsyncClient
from daemon_bench import PATIENCE, far_end, until, until_state, write_daemon
from daemon_process import (
    ERA,
    daemon_process,
    playing_daemon,
    run_era,
)

pytestmark = pytest.mark.real_time


async def test_second_daemon_is_refused_while_first_plays_on(tmp_path: Path) -> None:
    """Exit status 2 with the process id of the first; at another socket it waits for the link."""
    async with playing_daemon(tmp_path) as (daemon, era, _):
        status, _, err = await run_era("daemon", tmp_path / "daemon.yaml")
        assert status == 2
        assert f"process {daemon.process.pid}" in err
        text = (tmp_path / "daemon.yaml").read_text("utf-8")
        (tmp_path / "other.yaml").write_text(text.replace("era.sock", "b.sock"), "utf-8")
        other = await asyncio.create_subprocess_exec(
            *(ERA, "daemon", tmp_path / "other.yaml"), stderr=asyncio.subprocess.PIPE
        )
        await until((tmp_path / "b.sock").is_socket)
        async with await AsyncClient.connect(tmp_path / "b.sock", name="test") as waiting:
            await until_state(waiting, "COMM_LOST")
        other.terminate()
        _, log = await other.communicate()
        assert b"Traceback" not in log
        assert (await era.status()).state == "OPERATION_ENABLED"
        await until(lambda: any(daemon.far.summary().levels))


async def test_start_that_is_stuck_ends_by_sigterm(tmp_path: Path) -> None:
    """In a library that looks at no signal, as one that waits for memory."""
    stuck = (
        "import ctypes, controller.daemon.run as daemon\nfrom controller.cli.main import main\n"
        "def table(config):\n"
        "    lock, mutex = ctypes.CDLL(None).pthread_mutex_lock, ctypes.create_string_buffer(64)\n"
        "    print(flush=True)\n"
        "    lock(mutex), lock(mutex)\n"
        "daemon._table = table\nmain()"
    )
    process = await asyncio.create_subprocess_exec(
        *(sys.executable, "-c", stuck, "daemon", write_daemon(tmp_path, {"main": "sim://"})),
        stdout=asyncio.subprocess.PIPE,
        stderr=asyncio.subprocess.DEVNULL,
    )
    assert process.stdout is not None
    assert await asyncio.wait_for(process.stdout.readline(), PATIENCE)
    process.terminate()
    try:
        assert await asyncio.wait_for(process.wait(), PATIENCE) == -signal.SIGTERM
    finally:
        with contextlib.suppress(ProcessLookupError):
            process.kill()


def serves(port: int) -> bool:
    """Whether connections are accepted."""
    with socket.socket() as client:
        return client.connect_ex(("127.0.0.1", port)) == 0


async def page(port: int, path: str) -> str:
    """Get a page."""
    url = f"http://127.0.0.1:{port}{path}"
    return (await asyncio.to_thread(httpx.get, url, timeout=PATIENCE)).text


async def test_dashboard_process_ends_with_killed_daemon(tmp_path: Path) -> None:
    """`--dashboard` prints the address of the page."""
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    async with far_end(tmp_path) as far:
        options = ("--dashboard", f"127.0.0.1:{port}")
        async with daemon_process(tmp_path, far, options=options) as daemon:
            assert daemon.process.stdout is not None
            line = await asyncio.wait_for(daemon.process.stdout.readline(), PATIENCE)
            assert line.decode().startswith(f"dashboard: http://127.0.0.1:{port}/")
            await until(lambda: serves(port))
            assert "<html" in await page(port, "/")
            while "era_up 1.0" not in (metrics := await page(port, "/metrics")):
                assert "era_up 0.0" in metrics  # not connected to the daemon yet
            daemon.process.kill()
            await daemon.process.wait()
            await until(lambda: not serves(port))

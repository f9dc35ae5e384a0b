"""A whole daemon within the test's event loop, over a pseudo-terminal to a far end beside it."""

import asyncio
import logging
import time
from collections.abc import AsyncIterator, Callable, Sequence
from contextlib import asynccontextmanager
from dataclasses import dataclass
from functools import cache
from pathlib import Path

from controller.api.async_client import AsyncClient
from controller.daemon.config import load_daemon_config
from controller.daemon.daemon import Daemon
from controller.daemon.log import LogHandler, LogThread
from controller.daemon.service_manager import ServiceManager
from controller.daemon.socket_lock import SocketLock
from model.rig.file import load_rig
from model.table.table import LocalizationTable
from rig_files import write_rig
from small_table import small_table
from wires import WIRES, FarSide, far_side

PATIENCE = 20.0  # s; for a loaded machine, not an expectation
PLACE = (0.1, 0.1)


@dataclass
class DaemonBench:
    """A daemon that serves, and its far end."""

    daemon: Daemon
    far: FarSide
    folder: Path
    socket: Path

    async def client(self, name: str = "test") -> AsyncClient:
        """A client that has said hello."""
        return await AsyncClient.connect(self.socket, name=name, timeout=PATIENCE)


@cache
def daemon_table() -> LocalizationTable:
    """A small table of the example's plate."""
    return small_table()


def write_daemon(
    folder: Path,
    urls: dict[str, str],
    more: str = "",
    *,
    changes: Sequence[tuple[str, str]] = (),
) -> Path:
    """A rig at these URLs and a daemon's file beside it.

    more: further lines of that; changes: of the rig's text, before the URLs.
    """
    write_rig(
        folder / "rig.yaml",
        *changes,
        *(
            (f'{name}: {{url: "sim://"}}', f'{name}: {{url: "{url}"}}')
            for name, url in urls.items()
        ),
    )
    path = folder / "daemon.yaml"
    path.write_text(f"rig: rig.yaml\nsocket: era.sock\n{more}", encoding="utf-8")
    return path


@asynccontextmanager
async def running_daemon(folder: Path, more: str = "") -> AsyncIterator[DaemonBench]:
    """A daemon that serves, from a file with these further lines; ended with the context."""
    async with far_end(folder) as far, daemon_at(far, folder, more) as bench:
        yield bench


@asynccontextmanager
async def far_end(
    folder: Path, *, changes: Sequence[tuple[str, str]] = ()
) -> AsyncIterator[FarSide]:
    """The example's amplifier on a pseudo-terminal; changes: of the rig's text."""
    rig = load_rig(write_rig(folder / "bench.yaml", *changes))
    async with far_side(WIRES["serial"], rig) as far:
        yield far


@asynccontextmanager
async def daemon_at(
    far: FarSide, folder: Path, more: str = "", *, changes: Sequence[tuple[str, str]] = ()
) -> AsyncIterator[DaemonBench]:
    """A daemon that serves, for a far end that is there; changes: of the rig's text."""
    config = load_daemon_config(write_daemon(folder, dict(far.urls), more, changes=changes))
    place = SocketLock(config.socket)
    log = LogThread(folder / "log")
    handler = LogHandler(log)
    daemon = Daemon(config, daemon_table(), log=log, manager=ServiceManager({}), dashboard=None)
    task = asyncio.create_task(daemon.run(place))
    logging.getLogger().addHandler(handler)
    try:
        await until(lambda: config.socket.is_socket() or task.done())
        if task.done():
            task.result()
        yield DaemonBench(daemon, far, folder, config.socket)
    finally:
        daemon.shut_down("the test is over")
        try:
            await asyncio.wait_for(task, PATIENCE)
        finally:
            logging.getLogger().removeHandler(handler)
            log.close()
            place.release()


async def until(holds: Callable[[], object], *, patience: float = PATIENCE) -> None:
    """Wait until something holds; fails when the patience [s] is over."""
    end = time.monotonic() + patience
    while not holds():
        assert time.monotonic() < end, "it never came to hold"
        await asyncio.sleep(0.005)


async def until_state(client: AsyncClient, *states: str) -> str:
    """Wait until the daemon is in one of these states; which one."""
    end = time.monotonic() + PATIENCE
    while (state := (await client.status()).state) not in states:
        assert time.monotonic() < end, f"the daemon stays in {state}"
        await asyncio.sleep(0.01)
    return state

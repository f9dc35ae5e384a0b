"""A daemon within the test's event loop, over a line to simulated amplifiers.

In virtual time the line is memory, and a witness that reads every byte is the judge; in real time
it is a pseudo-terminal.
"""

import asyncio
import contextlib
import logging
from collections.abc import AsyncIterator, Awaitable, Callable, Mapping, Sequence
from contextlib import asynccontextmanager
from dataclasses import dataclass
from functools import cache, partial
from pathlib import Path
from typing import Any

import pytest

from chain import Chain
from controller.api.client import AsyncClient
from controller.api.jsonrpc import ErrorCode, RpcError
from controller.api.link import Notification
from controller.daemon.config import load_daemon_config
from controller.daemon.daemon import Daemon
from controller.process.daemon_process import ServiceManager, SocketLock
from controller.process.log import LogThread
from drivers.host.amplifier import WATCHDOG
from model.rig.rig import Rig
from model.rig.rig_file import load_rig
from model.table.table import LocalizationTable
from plate_judge import PlateJudge
from registry import threads
from rig_files import write_rig
from rig_on_wire import WIRES, FarSide, far_side
from small_table import small_table
from virtual_loop import VirtualLoop
from witness_config import LoopWitness, tell_first

PATIENCE = 180.0  # s; generous, for a loaded machine
PLACE = (0.1, 0.1)
READY, ENABLED = "READY_TO_SWITCH_ON", "OPERATION_ENABLED"


@dataclass
class DaemonBench:
    """A serving daemon, its far end, and the task that runs it."""

    daemon: Daemon
    far: FarSide
    socket: Path
    running: "asyncio.Task[None]"

    async def client(self, name: str = "test") -> AsyncClient:
        """Connect a client."""
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
    """Write a rig with these URLs and a daemon's file beside it.

    more: further lines of the daemon's file; changes: replacements in the rig's text.
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
async def ready_daemon(
    folder: Path, more: str = "", **options: Any
) -> AsyncIterator[tuple[DaemonBench, AsyncClient]]:
    """A daemon that is ready to be armed, and a client of it; options: as for `daemon_at`."""
    async with running_daemon(folder, more, **options) as bench, await bench.client() as era:
        await ready(era)
        yield bench, era


@asynccontextmanager
async def running_daemon(
    folder: Path, more: str = "", **options: Any
) -> AsyncIterator[DaemonBench]:
    """A serving daemon; more: further lines of its file; options: as for `daemon_at`."""
    async with far_end(folder) as far, daemon_at(far, folder, more, **options) as bench:
        yield bench


@asynccontextmanager
async def far_end(
    folder: Path, *, changes: Sequence[tuple[str, str]] = ()
) -> AsyncIterator[FarSide]:
    """The example's amplifier on a serial line; changes: replacements in the rig's text."""
    rig = load_rig(write_rig(folder / "bench.yaml", *changes))
    async with far_side(WIRES["serial"], rig) as far:
        yield far


@asynccontextmanager
async def daemon_at(
    far: FarSide,
    folder: Path,
    more: str = "",
    *,
    changes: Sequence[tuple[str, str]] = (),
    environment: Mapping[str, str] | None = None,
    table: Callable[[Rig], LocalizationTable] = lambda rig: daemon_table(),
) -> AsyncIterator[DaemonBench]:
    """A serving daemon at an existing far end.

    changes: replacements in the rig's text; environment: that its service manager gives it; table:
    that of its rig.
    """
    config = load_daemon_config(write_daemon(folder, dict(far.urls), more, changes=changes))
    lock, log = SocketLock(config.socket), LogThread(folder / "log")
    manager = ServiceManager(environment or {})
    loop = asyncio.get_running_loop()
    is_virtual = isinstance(loop, VirtualLoop)
    # Daemon, amplifier and test share a process, which a busy machine delays; in real time the
    # watchdog is the longest of the protocol, since no test of this bench lets it expire.
    daemon = Daemon(
        config,
        table(config.rig),
        log=log,
        manager=manager,
        dashboard=None,
        watchdog=WATCHDOG if is_virtual else 2.0,
    )
    chain = chain_of(daemon, far) if is_virtual else None
    task = asyncio.create_task(daemon.run(lock))
    logging.getLogger().addHandler(log)
    try:
        await until(lambda: config.socket.is_socket() or task.done())
        if task.done():
            task.result()
        yield DaemonBench(daemon, far, config.socket, task)
    finally:
        daemon.shut_down("end of the test")
        try:
            await asyncio.wait_for(task, None if is_virtual else PATIENCE)
        finally:
            logging.getLogger().removeHandler(log)
            log.close()
            manager.close()
            lock.release()
    if chain is not None:
        chain.plate_judge.close()
        chain.judge()


def chain_of(daemon: Daemon, far: FarSide) -> Chain:
    """The chain of a daemon in virtual time, which hears of its fingers and faults."""
    assert far.machine is not None
    witness = LoopWitness(far.urls)
    chain = Chain(far, far.machine, witness, PlateJudge(far, witness), lambda: daemon._controller)
    touched = partial(chain.plate_judge.touched, must_be_felt=False)
    for owner, method in ((daemon._controller.cycle, "deliver"), (daemon._inputs, "_deliver")):
        tell_first(owner, method, touched)
    for device in far.devices.values():
        tell_first(device, "inject_fault", lambda *_: witness.disturb())
    return chain


@asynccontextmanager
async def holding(
    era: AsyncClient, *places: tuple[float, float], far: FarSide | None = None
) -> AsyncIterator[None]:
    """Hold fingers down while the connection lasts; far: wait until its amplifier plays."""

    async def repeat() -> None:
        with contextlib.suppress(ConnectionError):
            while True:
                await era.touch(places or [PLACE])
                await asyncio.sleep(0.03)

    task = asyncio.create_task(repeat())
    try:
        if far is not None:
            await until(lambda: any(far.summary().levels))
        yield
    finally:
        task.cancel()
        await asyncio.gather(task, return_exceptions=True)


async def until(holds: Callable[[], object], *, patience: float = PATIENCE) -> None:
    """Wait until a condition holds; fail after `patience` [s]."""
    end = threads.now() + patience
    while not holds():
        assert threads.now() < end, "condition not met in time"
        await asyncio.sleep(0.005)


async def until_state(client: AsyncClient, *states: str) -> str:
    """Wait until the daemon is in one of these states; return it."""
    end = threads.now() + PATIENCE
    while (state := (await client.status()).state) not in states:
        assert threads.now() < end, f"daemon stays in {state}: {(await client.status()).cause}"
        await asyncio.sleep(0.01)
    return state


async def ready(era: AsyncClient) -> None:
    """Wait until it can be armed; acknowledge any stop, loss or fault, as of a busy machine."""
    while await until_state(era, READY, "FAULT", "QUICK_STOP_ACTIVE") != READY:
        with contextlib.suppress(RpcError):  # the cause may persist
            await era.clear()


async def next_event(client: AsyncClient, *topics: str) -> Notification:
    """Wait for the next notification of one of these topics."""
    async with asyncio.timeout(PATIENCE):
        async for event in client.events():
            if event.topic in topics:
                return event
    raise AssertionError("connection closed")


async def error_code(request: Awaitable[object]) -> ErrorCode:
    """Await a request that must be refused; return the code."""
    with pytest.raises(RpcError) as caught:
        await request
    return caught.value.code

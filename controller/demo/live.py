"""The interactive demonstration: simulated amplifiers, a daemon, and the dashboard."""

import tempfile
from contextlib import AsyncExitStack
from dataclasses import replace
from pathlib import Path

from controller.daemon.config import load_daemon_config
from controller.daemon.daemon import Daemon
from controller.daemon.log import start_log
from controller.daemon.service_manager import ServiceManager
from controller.daemon.socket_lock import SocketLock
from controller.demo.far_end import WATCHDOG, simulated_plate
from controller.gateway.installed import require_gateway
from model.rig.file import load_rig
from model.table.table import LocalizationTable


async def run_live(
    rig_file: Path,
    table: LocalizationTable,
    *,
    wire: str,
    dashboard: str,
    seed: int | None = 0,
) -> None:
    """Serve the dashboard of a rig over a wire until Ctrl-C; starts disarmed.

    wire, seed: as for `run_demo`; dashboard: HOST:PORT of the loopback. The daemon uses the default
    socket, so that `era status` and others reach it. Raises InputError if one runs already or
    the gateway is not installed, and LinkError.
    """
    require_gateway()
    rig = load_rig(rig_file)
    async with AsyncExitStack() as stack:
        folder = stack.enter_context(tempfile.TemporaryDirectory(prefix="era-"))
        file = Path(folder) / "daemon.yaml"
        file.write_text(f"rig: {rig_file}\nlog: {{level: warning}}\n", encoding="utf-8")
        config = load_daemon_config(file)
        lock = SocketLock(config.socket)
        stack.callback(lock.release)
        log = start_log(None, level=config.section.log.level)
        stack.callback(log.close)
        plate = await stack.enter_async_context(
            simulated_plate(rig_file, rig.amplifiers, wire=wire, seed=seed)
        )
        daemon = Daemon(
            replace(config, urls=plate.urls),
            table,
            log=log,
            manager=ServiceManager(),
            dashboard=dashboard,
            watchdog=WATCHDOG,
        )
        await daemon.run(lock)

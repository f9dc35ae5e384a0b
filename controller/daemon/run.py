"""`era daemon`: from a file to a running daemon, and back out of it."""

import asyncio
import logging
import sys
from pathlib import Path

from controller.daemon.config import DaemonConfig, load_daemon_config
from controller.daemon.daemon import Daemon
from controller.daemon.log import LogThread, start_log
from controller.daemon.notify import ServiceManager
from controller.daemon.sections import loopback_address
from controller.daemon.socket_lock import SocketLock
from drivers.errors import DriverError
from model.config.document import ConfigError, read_document
from model.counting import counted
from model.errors import InputError
from model.table.file import load_table
from model.table.table import LocalizationTable
from model.table.table_cache import cached_table

_SWITCH_INTERVAL = 0.001  # s; another thread keeps the control loop waiting no longer

_logger = logging.getLogger(__name__)


def check_daemon(path: Path) -> str:
    """Read a daemon's file and all that it names; what was found, or ConfigError, InputError."""
    config = load_daemon_config(path)
    if config.table is None:
        table = "its table is built, or taken from the cache, when it starts"
    else:
        loaded = _load_table(config, config.table)
        frequencies = counted(len(loaded.frequencies), "frequency", plural="frequencies")
        table = f"its table has {frequencies}"
    eras, amplifiers = counted(len(config.rig.eras), "ERA"), counted(len(config.urls), "amplifier")
    return f"{path}: good: {eras}, {amplifiers}; {table}"


def run_daemon(path: Path, *, dashboard: str | None) -> None:
    """Run a daemon until it is told to end; raises what keeps it from beginning.

    dashboard: HOST:PORT on the loopback, in place of what the file says.
    """
    try:
        at = None if dashboard is None else loopback_address(dashboard)
    except ValueError as error:
        raise InputError(f"--dashboard {error}") from error
    config = load_daemon_config(path)
    _try_log(config)
    place = SocketLock(config.socket)
    try:
        log = start_log(config.log_file, level=config.section.log.level)
        try:
            _run(config, place, log=log, dashboard=at or config.section.dashboard)
        finally:
            log.close()
    finally:
        place.leave()


def _try_log(config: DaemonConfig) -> None:
    """Refuse to begin with a log that cannot be written; later that only costs lines."""
    file = config.log_file
    try:
        if file is not None:
            file.open("a", encoding="utf-8").close()
    except OSError as error:
        raise InputError(
            f"{config.source}: log.file: {file} cannot be written ({error.strerror}); give this "
            "user the right to, or name another file"
        ) from error


def _run(config: DaemonConfig, place: SocketLock, *, log: LogThread, dashboard: str | None) -> None:
    manager = ServiceManager()
    manager.status("the localization table is made ready")
    table = _table(config)
    sys.setswitchinterval(_SWITCH_INTERVAL)

    async def run() -> None:
        daemon = Daemon(config, table, log=log, manager=manager, dashboard=dashboard)
        await daemon.run(place)

    try:
        asyncio.run(run())
    except (InputError, DriverError) as error:
        _logger.error("the daemon ends: %s", error)
        raise
    except Exception:
        _logger.exception("the daemon ends")
        raise
    finally:
        manager.close()


def _load_table(config: DaemonConfig, file: Path) -> LocalizationTable:
    """The table that the file names; ConfigError says on which line of it."""
    try:
        return load_table(file, fingerprint=config.rig.fingerprint)
    except InputError as error:
        document = read_document(config.source)
        problem = document.problem(("table",), str(error))
        raise ConfigError(document.source, [problem]) from error


def _table(config: DaemonConfig) -> LocalizationTable:
    if config.table is not None:
        return _load_table(config, config.table)
    table, file = cached_table(config.rig)
    _logger.info("the localization table is %s", file or "not kept for the next start")
    return table

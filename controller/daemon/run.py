"""`era daemon`: from a configuration file to a running daemon."""

import asyncio
import atexit
import logging
import resource
import signal
import sys
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path

from controller.api.connection import MIN_DESCRIPTORS, allow_many_descriptors
from controller.daemon.config import DaemonConfig, load_daemon_config
from controller.daemon.config_sections import loopback_address
from controller.daemon.daemon import Daemon
from controller.gateway.settings import require_gateway
from controller.process.log import LogThread, open_log_file, start_log
from controller.process.service_manager import ServiceManager
from controller.process.socket_lock import SocketLock
from drivers.errors import DriverError
from drivers.trace import tracing
from model.compiled.kernels import kernels
from model.config.document import ConfigError, read_document
from model.errors import InputError
from model.quantities import counted
from model.table.table import LocalizationTable
from model.table.table_file import cached_table, load_table
from registry.threads import leave_work

_IGNORED = (signal.SIGHUP, signal.SIGUSR1, signal.SIGUSR2)
_MIN_ADDRESS_SPACE = 512  # MB; with less, libraries that it needs wait for memory for ever
_SWITCH_INTERVAL = 0.001  # s; bounds how long another thread can delay the control loop

_logger = logging.getLogger(__name__)


def check_daemon(path: Path) -> str:
    """Check a daemon's file and all files that it names; return a summary.

    Raises ConfigError or InputError.
    """
    config = load_daemon_config(path)
    if config.table is None:
        table = "table built or taken from the cache at the start"
    else:
        loaded = _load_table(config, config.table)
        frequencies = counted(len(loaded.frequencies), "frequency", plural="frequencies")
        table = f"table with {frequencies}"
    eras, amplifiers = counted(len(config.rig.eras), "ERA"), counted(len(config.urls), "amplifier")
    return f"{path}: good: {eras}, {amplifiers}; {table}"


def run_daemon(path: Path, *, dashboard: str | None, trace: Path | None = None) -> None:
    """Run a daemon until it is terminated; raises errors of its start.

    dashboard: HOST:PORT on the loopback; overrides the file. trace: a file for everything on the
    wires.
    """
    address = None if dashboard is None else page_address(dashboard)
    with ExitStack() as stack:
        stack.enter_context(_ignored_signals())
        _check_limits()
        if trace is not None:
            stack.enter_context(tracing(trace))
        config = load_daemon_config(path)
        _check_log_file(config)
        lock = SocketLock(config.socket)
        stack.callback(lock.release)
        log = start_log(config.log_file, level=config.section.log.level)
        stack.callback(log.close)
        _run(config, lock, log=log, dashboard=address or _page_of_file(config))
    atexit.register(leave_work)


def page_address(text: str) -> str:
    """Return the HOST:PORT of an option --dashboard unchanged; raises InputError."""
    try:
        return loopback_address(text)
    except ValueError as error:
        raise InputError(f"--dashboard: {error}") from error


def _page_of_file(config: DaemonConfig) -> str | None:
    """Where the file wants the page; None, and a warning, where its libraries are missing."""
    try:
        if config.section.dashboard is not None:
            require_gateway()
    except InputError as error:
        _logger.warning("dashboard: %s; going on without the page", error)
        return None
    return config.section.dashboard


def _check_limits() -> None:
    """Refuse to start where files or memory would run out."""
    descriptors = allow_many_descriptors()
    if descriptors < MIN_DESCRIPTORS:
        raise InputError(
            f"limit of open files must be at least {MIN_DESCRIPTORS}, got {descriptors}; raise it "
            "(ulimit -n, LimitNOFILE=)"
        )
    space, _ = resource.getrlimit(resource.RLIMIT_AS)
    if space != resource.RLIM_INFINITY and space >> 20 < _MIN_ADDRESS_SPACE:
        raise InputError(
            f"limit of the address space must be at least {_MIN_ADDRESS_SPACE} MB, got "
            f"{space >> 20} MB; raise it (ulimit -v, LimitAS=)"
        )


@contextmanager
def _ignored_signals() -> Iterator[None]:
    """Ignore signals that would end the daemon but request nothing of it, or too early.

    SIGTERM ends it at once until it serves: nothing is open yet, and a library may be stuck.
    """
    before = {number: signal.signal(number, signal.SIG_IGN) for number in _IGNORED}
    before[signal.SIGTERM] = signal.signal(signal.SIGTERM, signal.SIG_DFL)
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def _check_log_file(config: DaemonConfig) -> None:
    """Refuse to start with an unwritable log; later a failing log only loses lines."""
    file = config.log_file
    try:
        if file is not None:
            open_log_file(file).close()
    except OSError as error:
        raise InputError(
            f"{config.source}: log.file: cannot write {file}: {error.strerror}; grant this user "
            "access or choose another file"
        ) from error


def _run(config: DaemonConfig, lock: SocketLock, *, log: LogThread, dashboard: str | None) -> None:
    manager = ServiceManager()
    manager.notify("STATUS=preparing the localization table")
    table = _table(config)
    sys.setswitchinterval(_SWITCH_INTERVAL)

    async def run() -> None:
        daemon = Daemon(config, table, log=log, manager=manager, dashboard=dashboard)
        await daemon.run(lock)

    try:
        asyncio.run(run())
    except (InputError, DriverError) as error:
        _logger.error("daemon: terminated: %s", error)
        raise
    except Exception:
        _logger.exception("daemon: terminated")
        raise
    finally:
        manager.close()


def _load_table(config: DaemonConfig, file: Path) -> LocalizationTable:
    """Load the table named in the file; raises ConfigError with the line that names it."""
    try:
        return load_table(file, rig=config.rig)
    except InputError as error:
        document = read_document(config.source)
        problem = document.problem(("table",), str(error))
        raise ConfigError(document.source, [problem]) from error


def _table(config: DaemonConfig) -> LocalizationTable:
    kernels()  # may be compiled, which must not be in the event loop
    if config.table is not None:
        return _load_table(config, config.table)
    table, file = cached_table(config.rig)
    _logger.info("localization table: %s", file or "not cached")
    return table

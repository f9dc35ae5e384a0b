"""The daemon: control loop, drivers and API assembled from a configuration, from start to end.

`run_daemon` is `era daemon CONFIG`: it checks limits, files and socket, builds or loads the
localization table, and runs a `Daemon` until it is terminated. The daemon starts disarmed; at its
end the amplifiers are silenced before anything else is closed.
"""

import asyncio
import atexit
import logging
import resource
import signal
import sys
import time
from collections.abc import Awaitable, Callable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import replace
from pathlib import Path

from controller.api.methods import ReloadResult
from controller.api.schema import headline
from controller.api.server import ApiServer
from controller.daemon.children import gateway_options, keep_gateway
from controller.daemon.config import DaemonConfig, load_daemon_config, loopback_address
from controller.daemon.handlers import ApiService
from controller.daemon.layouts import LayoutChoice, TouchInputs
from controller.daemon.messages import EventPublisher
from controller.daemon.reload import ConfigReload
from controller.gateway.gateway_settings import require_gateway
from controller.operation.operation_states import ENERGISED, Operation
from controller.operation.plate_controller import Controller
from controller.operation.supervisor import Supervisor
from controller.play.reports import Observers
from controller.process.daemon_process import (
    MIN_DESCRIPTORS,
    SocketLock,
    allow_many_descriptors,
)
from controller.process.log import LogThread, open_log_file, start_log
from drivers.errors import DriverError
from drivers.host.amplifier import WATCHDOG
from drivers.opening import Lines
from drivers.trace import tracing
from model.answer.answer_report import Timing
from model.compiled.kernels import kernels
from model.config.document import ConfigError, read_document
from model.errors import InputError
from model.quantities import counted
from model.table.table import LocalizationTable
from model.table.table_file import cached_table, load_table
from registry import threads
from registry.service_manager import ServiceManager
from registry.threads import DaemonThreads, leave_work, no_long_collections

_CLOSE_TIMEOUT = 0.2  # s; for the control loop to end after all reachable amplifiers are silent
_IGNORED = (signal.SIGHUP, signal.SIGUSR1, signal.SIGUSR2)
_MIN_ADDRESS_SPACE = 512  # MB; with less, libraries that it needs wait for memory for ever
_SWITCH_INTERVAL = 0.001  # s; bounds how long another thread can delay the control loop

_logger = logging.getLogger(__name__)


class Daemon:
    """A daemon; create it within the event loop that runs it.

    dashboard: HOST:PORT at which the gateway serves the page, or None.
    shows_token: whether to print the page's token even if the output may be logged.
    observe: adds observers of the control loop.
    lines: makes the lines to the amplifiers.
    watchdog [s]: of the amplifiers; longer for simulated ones on a busy machine.
    handles_signals: whether signals end it or reload it; only in the main thread.

    Its parts are the attributes `controller`, `supervisor`, `publisher`, `layouts`, `inputs`, `api`
    and `server`.
    """

    def __init__(
        self,
        config: DaemonConfig,
        table: LocalizationTable,
        *,
        log: LogThread,
        manager: ServiceManager,
        dashboard: str | None,
        shows_token: bool = False,
        observe: Callable[[Observers], None] = lambda loop: None,
        lines: Callable[[Lines | None], Lines] = Lines,
        watchdog: float = WATCHDOG,
        handles_signals: bool = True,
    ) -> None:
        rendered_config = config.for_table(table.frequencies)
        self._log = log
        self._manager = manager
        self._dashboard = dashboard
        self._shows_token = shows_token
        self._handles_signals = handles_signals
        self._gateway: asyncio.Task[None] | None = None
        self._shutdown = asyncio.Event()
        self._shutdown_cause = "the daemon is shutting down"
        self.layouts = LayoutChoice(rendered_config, table.frequencies)
        self.controller = Controller(
            config.rig,
            table,
            lines=lines,
            urls=config.urls,
            serial_numbers=config.section.serial_numbers,
            intent_source=self.layouts.player,
            timing=Timing(table),
            drive_mode=config.section.mode,
            watchdog=watchdog,
        )
        self.supervisor = Supervisor(self.controller, alive=lambda: manager.alive(threads.now()))
        self.started = self.supervisor.started
        """Set once it serves, and its amplifiers are open or searched for."""
        self._config_reload = ConfigReload(
            rendered_config,
            table.frequencies,
            self.layouts,
            is_armed=self._is_armed,
            started=self._reload_started,
            ended=self._reload_ended,
        )
        cycle = self.controller.cycle
        cycle.tracker.max_fingers = config.section.max_fingers
        self.inputs = TouchInputs(cycle.deliver, cycle.lift, rejects=cycle.rejects)
        self.publisher = EventPublisher(
            self.supervisor, layouts=self.layouts, touch_inputs=self.inputs
        )
        self.supervisor.current.observers.append(self._notify_manager)
        self.layouts.observers.append(cycle.request_update)
        observe(cycle.observers)
        self.api = ApiService(
            # Without layouts, so that these can be freed once they are replaced.
            replace(config, layouts={}),
            table,
            self.controller,
            self.supervisor,
            publisher=self.publisher,
            layouts=self.layouts,
            reload=self.reload,
        )
        self.server = ApiServer(
            self.api.handlers(),
            on_disconnect=self.api.client_left,
            holds_lease=self.api.holds_lease,
            is_busy=lambda: cycle.is_preparing,
            stop_all=self.supervisor.stop_despite_failure,
            clock=threads.now,
        )

    @property
    def config(self) -> DaemonConfig:
        """The configuration in use."""
        return self._config_reload.config

    def _notify_manager(self, old: Operation, new: Operation) -> None:
        self._manager.notify(f"STATUS={headline(new.state.value, new.cause)}")

    async def run(self, lock: SocketLock) -> None:
        """Open, serve until terminated, silence the amplifiers and close.

        Amplifiers that do not reply are searched for meanwhile. Raises CommandError and InputError
        for amplifiers that do not fit the configuration.
        """
        loop = asyncio.get_running_loop()
        loop.set_default_executor(DaemonThreads())
        if self._handles_signals:
            for number in (signal.SIGTERM, signal.SIGINT):
                cause = f"{signal.strsignal(number)} received"
                loop.add_signal_handler(number, self.shut_down, cause)
            loop.add_signal_handler(signal.SIGHUP, self._config_reload.request)
        reloading = asyncio.create_task(self._config_reload.run(), name="reloads")
        running: asyncio.Task[None] | None = None
        try:
            await self.server.open(lock.bind())
            self._log.subscriber = self.publisher.logged
            running = asyncio.create_task(self.supervisor.run(), name="control loop")
            self.inputs.start(self.config.touch)
            if self._dashboard is not None:
                options = gateway_options(
                    self._dashboard, self.config.socket, shows_token=self._shows_token
                )
                self._gateway = asyncio.create_task(keep_gateway(options), name="gateway")
            shutdown = asyncio.create_task(self._shutdown.wait())
            started = asyncio.create_task(self.started.wait())
            await asyncio.wait({running, shutdown, started}, return_when=asyncio.FIRST_COMPLETED)
            with no_long_collections():
                if started.done():
                    self._manager.ready(self._status_line())
                    _logger.info("serving at %s", lock.path)
                await asyncio.wait({running, shutdown}, return_when=asyncio.FIRST_COMPLETED)
            shutdown.cancel()
            started.cancel()
        finally:
            reloading.cancel()
            await self._close(running)
        if not running.cancelled():
            running.result()

    def shut_down(self, cause: str) -> None:
        """Request an orderly shutdown."""
        self._shutdown_cause = cause
        self._shutdown.set()

    async def reload(self) -> ReloadResult:
        """Read the configuration again and apply its layouts, if nothing else has changed.

        While one is being read, all further requests are combined into one after it.
        """
        return await self._config_reload.result()

    def _is_armed(self) -> bool:
        return self.supervisor.operation.state in ENERGISED

    def _reload_started(self) -> None:
        self._manager.notify("RELOADING=1", f"MONOTONIC_USEC={time.monotonic_ns() // 1000}")

    def _reload_ended(self) -> None:
        self._manager.ready(self._status_line())

    async def _close(self, running: "asyncio.Task[None] | None") -> None:
        """Silence the amplifiers first, then close everything else."""
        self._manager.notify("STOPPING=1")
        try:
            await self.supervisor.close(self._shutdown_cause)
        finally:
            if running is not None:
                _, late = await asyncio.wait({running}, timeout=_CLOSE_TIMEOUT)
                for task in late:  # waiting for an amplifier that does not reply
                    task.cancel()
                    await asyncio.wait({task})
            self._log.subscriber = None
            closing: list[Awaitable[None]] = [
                self.inputs.close(),
                self.server.close(),
                self.api.close(),
            ]
            if self._gateway is not None:
                self._gateway.cancel()
                closing.append(self._gateway)
            for result in await asyncio.gather(*closing, return_exceptions=True):
                if isinstance(result, Exception) and not isinstance(result, OSError):
                    _logger.error("closing failed", exc_info=result)
            self.publisher.hub.close()

    def _status_line(self) -> str:
        operation = self.supervisor.operation
        return headline(operation.state.value, operation.cause)


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
    eras = counted(len(config.rig.eras), "ERA")
    amplifiers = counted(len(config.urls), "amplifier")
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
        run_until_stopped(config, lock, log=log, dashboard=address or _page_of_file(config))
    atexit.register(leave_work)


def page_address(text: str) -> str:
    """Return the HOST:PORT of an option --dashboard unchanged; raises InputError."""
    try:
        return loopback_address(text)
    except ValueError as error:
        raise InputError(f"--dashboard: {error}") from error


def _page_of_file(config: DaemonConfig) -> str | None:
    """Return the page's address in the file; warn and return None if libraries are missing."""
    try:
        if config.section.dashboard is not None:
            require_gateway()
    except InputError as error:
        _logger.warning("dashboard: %s; going on without the page", error)
        return None
    return config.section.dashboard


def _check_limits() -> None:
    """Refuse to start if files or memory would run out."""
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
    """Ignore signals that would end the daemon by accident or too early.

    SIGTERM ends it immediately until it serves: nothing is open yet, and a library could be stuck.
    """
    handlers = {number: signal.signal(number, signal.SIG_IGN) for number in _IGNORED}
    handlers[signal.SIGTERM] = signal.signal(signal.SIGTERM, signal.SIG_DFL)
    try:
        yield
    finally:
        for number, handler in handlers.items():
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


def run_until_stopped(
    config: DaemonConfig, lock: SocketLock, *, log: LogThread, dashboard: str | None
) -> None:
    """Prepare the table and serve until the daemon is terminated."""
    manager = ServiceManager()
    manager.notify("STATUS=preparing the localization table")
    table = prepared_table(config)
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
        return _with_touch_position(load_table(file, rig=config.rig), config)
    except InputError as error:
        document = read_document(config.source)
        problem = document.problem(("table",), str(error))
        raise ConfigError(document.source, [problem]) from error


def prepared_table(config: DaemonConfig) -> LocalizationTable:
    """Load the table that the configuration names, or build the one of its rig."""
    kernels()  # load the library here, not in the event loop
    if config.table is not None:
        return _load_table(config, config.table)
    table, file = cached_table(config.rig)
    _logger.info("localization table: %s", file or "not cached")
    return _with_touch_position(table, config)


def _with_touch_position(table: LocalizationTable, config: DaemonConfig) -> LocalizationTable:
    """Return the table with the uncertainty of touches from the calibration of their sources."""
    uncertainty = replace(table.uncertainty, touch_position=config.touch_position)
    if uncertainty == table.uncertainty:
        return table
    _logger.info("touch: positions within %.1f mm (RMS)", 1e3 * uncertainty.touch_position)
    return replace(table, uncertainty=uncertainty)

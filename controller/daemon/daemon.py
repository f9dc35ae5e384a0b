"""The daemon put together: control loop, drivers, API; from its configuration to its end."""

import asyncio
import contextlib
import logging
import signal

from controller.api.server import ApiServer
from controller.daemon.companions import Companion, Companions
from controller.daemon.config import DaemonConfig, load_daemon_config
from controller.daemon.dumps import Dumps
from controller.daemon.inputs import ApiTouches, TouchInputs
from controller.daemon.log import LogThread
from controller.daemon.meaning import Meaning
from controller.daemon.news import News
from controller.daemon.notify import ServiceManager
from controller.daemon.records import RecordedBackend, Recorder
from controller.daemon.reload import plan_reload
from controller.daemon.service import Service
from controller.daemon.socket_lock import SocketLock
from controller.daemon.states import Machine, State
from controller.daemon.supervisor import Supervisor
from controller.daemon.view import amplifier_statuses
from controller.loop.loop import Controller
from controller.sources.touch import TouchFrame
from drivers import clock
from drivers.amplifier import Amplifier
from drivers.errors import DriverError
from drivers.operation.steady import no_long_collections
from drivers.registry import open_backend
from drivers.threads import in_thread
from model.errors import InputError
from model.table.table import LocalizationTable
from model.table.timing import Timing
from registry.plugins import failure_text

_END_PATIENCE = 0.2  # s; by then whoever can be silenced has been

_logger = logging.getLogger(__name__)


class Daemon:
    """One daemon; `run` is its whole life. Must be made within the event loop that runs it.

    dashboard: HOST:PORT where the gateway shall serve the page, None for nowhere.
    """

    def __init__(
        self,
        config: DaemonConfig,
        table: LocalizationTable,
        *,
        log: LogThread,
        manager: ServiceManager,
        dashboard: str | None,
    ) -> None:
        self._config = config
        self._begun_with = config
        self._log = log
        self._manager = manager
        self._dashboard = dashboard
        self._loop = asyncio.get_running_loop()
        self._reloads: set[asyncio.Task[None]] = set()
        self._reloading = asyncio.Lock()
        self._reload_is_due = False
        self._ended = asyncio.Event()
        self._end_cause = "the daemon ends"
        self._recorder = Recorder()
        self._dumps = Dumps(self._recorder)
        backends = self._make_backends(config)
        amplifiers = {
            name: Amplifier(backend, serial_number=config.section.serial_numbers.get(name))
            for name, backend in backends.items()
        }
        self._supervisor = Supervisor(
            amplifiers,
            state_changed=self._state_changed,
            link_told=lambda *told: self._news.link_told(*told),
            alive=lambda: manager.alive(clock.now()),
        )
        self._meaning = Meaning(config.meaning)
        self._news = News(
            machine=lambda: self._supervisor.machine,
            amplifiers=lambda: amplifier_statuses(amplifiers, backends, config.urls),
            effect_of=self._meaning.effect_of,
            layout=config.layout,
            plain_because=lambda: self._controller.plain_because,
        )
        self._controller = Controller(
            config.rig,
            table,
            amplifiers=amplifiers,
            observer=self._supervisor.observe(self._news.observer()),
            intent_source=self._meaning,
            timing=Timing(table),
            drive_mode=config.section.mode,
            envelope_time=config.section.touch_wait,
        )
        self._touches = ApiTouches(config.rig.plate, self._deliver)
        self._inputs = TouchInputs(self._deliver, failed=self._input_failed)
        self._service = Service(
            config,
            table,
            self._controller,
            self._supervisor,
            amplifiers=amplifiers,
            news=self._news,
            touches=self._touches,
            meaning=self._meaning,
        )
        self._server = ApiServer(
            self._service.handlers(),
            left=self._service.left,
            keeps=self._service.keeps,
            clock=clock.now,
        )
        self._companions = Companions()

    async def run(self, place: SocketLock) -> None:
        """Open, serve until told to end, fall silent and close.

        Raises LinkError, CommandError and InputError where it cannot begin.
        """
        loop = asyncio.get_running_loop()
        for number in (signal.SIGTERM, signal.SIGINT):
            loop.add_signal_handler(number, self.end, f"told to end by {signal.strsignal(number)}")
        loop.add_signal_handler(signal.SIGHUP, self._reload_soon)
        running: asyncio.Task[None] | None = None
        try:
            if not await self._opened():
                return
            await self._server.open(place.bound())
            await self._inputs.exchange(self._config.touch)
            self._log.listener = self._news.logged
            running = asyncio.create_task(self._supervisor.run(), name="control loop")
            self._start_companions()
            ended = asyncio.create_task(self._ended.wait())
            with no_long_collections():
                self._manager.ready(self._status_line())
                _logger.info("serving at %s", place.path)
                await asyncio.wait({running, ended}, return_when=asyncio.FIRST_COMPLETED)
            ended.cancel()
        finally:
            await self._close(running)
        if not running.cancelled():
            running.result()

    async def _opened(self) -> bool:
        """Open the amplifiers; False where the daemon is told to end before they all answered."""
        opening = asyncio.create_task(self._supervisor.open(self._controller))
        ended = asyncio.create_task(self._ended.wait())
        await asyncio.wait({opening, ended}, return_when=asyncio.FIRST_COMPLETED)
        ended.cancel()
        if opening.done():
            opening.result()
            return True
        opening.cancel()
        await asyncio.wait({opening})
        return False

    def end(self, cause: str) -> None:
        """End in order; from a signal, or from whoever runs the daemon."""
        self._end_cause = cause
        self._ended.set()

    async def reload(self) -> None:
        """Read the configuration again, and take over what can be taken over."""
        async with self._reloading:
            self._reload_is_due = False  # whoever asks from here on means what is there then
            self._manager.reloading()
            try:
                source = self._config.source
                new = await in_thread(lambda: load_daemon_config(source), name="reload")
                await self._take_over(new)
            except InputError as error:
                _logger.error("the configuration is left as it was: %s", error)
            except Exception:  # whoever waits for the reload must hear of its end
                _logger.exception("the configuration could not be taken over")
            self._manager.ready(self._status_line())

    async def _take_over(self, new: DaemonConfig) -> None:
        is_armed = self._supervisor.machine.state in (State.SWITCHED_ON, State.OPERATION_ENABLED)
        plan = plan_reload(self._config, new, is_armed=is_armed)
        if plan.refused is not None:
            _logger.error("the configuration is left as it was: %s", plan.refused)
            return
        for key in plan_reload(self._begun_with, new, is_armed=False).restart:
            _logger.warning("%s has changed: restart the daemon to take it over", key)
        for key in plan.apply:
            match key:
                case "touch":
                    await self._inputs.exchange(new.touch)
                case "layout":
                    self._meaning.exchange(new.meaning)
                    self._news.layout_changed(new.layout)
                    self._controller.reconsider()
                case "longest_lease":
                    self._service.longest_lease = new.section.longest_lease
                case "log.level":
                    logging.getLogger().setLevel(new.section.log.level.upper())
                case _:
                    pass  # is read when it is needed
        self._config = new
        _logger.info("took over %s", ", ".join(plan.apply) or "nothing: all is as it was")

    async def _close(self, running: "asyncio.Task[None] | None") -> None:
        """Silence first; then everything else, as far as it comes."""
        self._manager.stopping()
        for reload in self._reloads:  # or it would start what is to end
            reload.cancel()
        try:
            await self._supervisor.close(self._end_cause)
        finally:
            if running is not None:
                _, late = await asyncio.wait({running}, timeout=_END_PATIENCE)
                for task in late:  # it waits for an amplifier that does not answer
                    task.cancel()
                    await asyncio.wait({task})
            self._log.listener = None
            for step in (self._inputs.close(), self._companions.close(), self._server.close()):
                with contextlib.suppress(OSError):
                    await step
            self._news.hub.close()

    def _make_backends(self, config: DaemonConfig) -> dict[str, RecordedBackend]:
        return {
            name: RecordedBackend(open_backend(url), name, self._recorder)
            for name, url in config.urls.items()
        }

    def _start_companions(self) -> None:
        socket = str(self._config.socket)
        if self._dashboard is not None:
            self._companions.start(
                Companion(
                    "controller.cli",
                    ("gateway", "--socket", socket, "--listen", self._dashboard),
                )
            )
        if self._config.section.metrics is not None:
            port = str(self._config.section.metrics)
            self._companions.start(
                Companion("controller.metrics", ("--socket", socket, "--port", port))
            )

    def _deliver(self, frame: TouchFrame) -> None:
        """Hand touches to the control loop; where there is none just now, they are not felt."""
        with contextlib.suppress(DriverError):
            self._controller.deliver(frame)

    def _input_failed(self, name: str, error: Exception) -> None:
        expected = isinstance(error, InputError | OSError)
        said = str(error) if expected else failure_text(error)
        _logger.error("touch source %s: failed, retrying: %s", name, said)

    def _state_changed(self, old: Machine, new: Machine) -> None:
        self._news.state_changed(old, new)
        self._service.state_changed(new)
        self._manager.status(f"{new.state.value}: {new.cause}")
        if new.state in (State.FAULT_REACTION_ACTIVE, State.COMM_LOST):
            self._dump(new.cause)

    def _dump(self, cause: str) -> None:
        folder, dumps = self._config.dump_folder, self._config.section.dumps
        if folder is not None and dumps is not None:
            self._dumps.write(folder, cause=cause, keep=dumps.keep)

    def _reload_soon(self) -> None:
        """Reload; while another one goes on, once after it, however often that is asked for."""
        if self._reload_is_due:
            return
        self._reload_is_due = True
        task = asyncio.ensure_future(self.reload())
        self._reloads.add(task)
        task.add_done_callback(self._reloads.discard)

    def _status_line(self) -> str:
        machine = self._supervisor.machine
        return f"{machine.state.value}: {machine.cause}"

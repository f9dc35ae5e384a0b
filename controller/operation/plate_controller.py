"""Controller of a plate: opens, arms, stops and releases the amplifiers of its control loop."""

import asyncio
from collections.abc import Awaitable, Callable, Coroutine, Mapping, Sequence
from typing import Any, TypeAlias

from controller.play.intent import IntentSource
from controller.play.loop import Cycle
from controller.play.planner import Planner
from controller.play.shared_capabilities import playback_capabilities
from drivers.errors import LinkError
from drivers.host.amplifier import CONFIRM_TIMEOUT, WATCHDOG, Amplifier
from drivers.host.group import Group
from drivers.host.group_states import GroupState
from drivers.host.stops import UNREACHED, StopOutcome
from drivers.opening import Lines
from drivers.protocol.definition import REPLY_TIMEOUT
from model.answer.answer_report import Timing
from model.drive_modes import UNRESTRICTED
from model.errors import InputError
from model.rig.rig import Rig
from model.table.table import LocalizationTable

CLOSING_RAMP = 0.050  # s; not urgent, so longer than a normal release

_Stopping: TypeAlias = Awaitable[Mapping[str, StopOutcome]]
"""A stop in progress, with its outcome by the amplifier's name."""


class Controller:
    """Drives the amplifiers of a rig by touch frames: open, arm, run its `cycle`, close.

    It starts disarmed: contacts are followed but nothing is sent. The loop itself sends the
    heartbeat at the end of each cycle, so that the amplifiers' watchdogs trip if the loop hangs.

    table: localization table of this rig.
    lines: makes the lines to the amplifiers; called for each opening.
    intent_source: selects the effects for contacts.
    timing: shapes the patterns of the table.
    urls, serial_numbers: by amplifier name.
    drive_mode: None for the best mode that the amplifiers support.
    watchdog: watchdog time of armed amplifiers [s].
    """

    def __init__(
        self,
        rig: Rig,
        table: LocalizationTable,
        *,
        lines: Callable[[Lines | None], Lines],
        intent_source: IntentSource,
        timing: Timing,
        urls: Mapping[str, str] | None = None,
        serial_numbers: Mapping[str, str] | None = None,
        drive_mode: str | None = None,
        watchdog: float = WATCHDOG,
    ) -> None:
        self.cycle = Cycle(rig.plate, Group({}, watchdog=watchdog))
        """The control loop."""
        self._rig = rig
        self.intent_source = intent_source
        self._timing = timing
        self.table = table
        """The localization table to query."""
        self.urls = dict(rig.amplifiers if urls is None else urls)
        if self.urls.keys() != rig.amplifiers.keys():
            raise InputError(
                f"amplifiers must match the rig ({', '.join(sorted(rig.amplifiers))}), got "
                f"{', '.join(sorted(self.urls)) or 'none'}"
            )
        self.make_lines = lines
        self._lines: Lines | None = None  # also set after a failed attempt to open
        self._last_lines: Lines | None = None  # the same, kept after closing
        self._opened: dict[str, Amplifier] = {}  # latest ones, identified or not
        self._pending_stops: dict[str, asyncio.Future[_Stopping]] = {}
        """Stops that wait for the line of an amplifier; each gets its result when it opens."""
        self._serial_numbers = dict(serial_numbers or {})
        self.connected: list[Callable[[Mapping[str, Amplifier]], None]] = []
        """Observers; called with all amplifiers once their lines are open."""
        self.watchdog = watchdog
        """Watchdog of armed amplifiers [s]."""
        self.amplifiers: dict[str, Amplifier] = {}
        """Amplifiers by name, as last identified; empty before."""
        self._drive_mode = drive_mode

    @property
    def group(self) -> Group:
        """All amplifiers together."""
        return self.cycle.group

    @property
    def is_released(self) -> bool:
        """Whether all lines are closed."""
        return self._lines is None

    @property
    def drive_mode(self) -> str:
        """Drive mode for table queries; the best possible mode until `open`."""
        if self.cycle.planner is not None:
            return self.cycle.planner.capabilities.drive_mode
        return self._drive_mode or UNRESTRICTED

    async def open(self) -> None:
        """Open all amplifiers or none, and prepare their playback; all stay disarmed.

        A pending stop reaches each amplifier as soon as its line is open, even if others fail. An
        amplifier that was open before must have the same serial number; its history for limits
        over time is kept. Raises LinkError, CommandError, and InputError if an amplifier lacks a
        wired channel or cannot play the drive mode. After a LinkError the lines stay open for the
        next attempt, until `release`, because a board may restart whenever its port is opened.
        """
        cycle = self.cycle
        cycle.is_closed = False
        if self._lines is None or self._lines.is_closing:
            self._lines = self.make_lines(self._last_lines)
            self._last_lines = self._lines
        try:
            amplifiers = await self._open_amplifiers(self._lines)
            capabilities = playback_capabilities(self._rig, amplifiers, drive_mode=self._drive_mode)
            planner = Planner(
                self._rig,
                self.table,
                tracker=cycle.tracker,
                capabilities=capabilities,
                intent_source=self.intent_source,
                timing=self._timing,
                check=self.group.sets.refusal_of,
                arrived=cycle.request_update,
                too_late=cycle.count_too_late,
                clock_errors=lambda: self.group.clock_errors,
            )
            clock_errors = self.group.clock_errors
            await asyncio.to_thread(planner.precompute, clock_errors)  # seconds for a large rig
        except BaseException as error:
            if not isinstance(error, LinkError):
                await self.release()
            raise
        cycle.planner = planner

    async def _open_amplifiers(self, lines: Lines) -> dict[str, Amplifier]:
        """Open a new group of all amplifiers; raises the errors of `open`."""
        cycle = self.cycle
        async with cycle.sending:  # to the previous amplifiers
            cycle.group = Group(self._opened, watchdog=self.watchdog, restored=cycle.feed_at_once)
        opening = [self._amplifier(lines, name) for name in self.urls]
        results = await asyncio.gather(*opening, return_exceptions=True)
        errors = {}
        for name, result in zip(self.urls, results, strict=True):
            if isinstance(result, LinkError):
                errors[name] = result
        for error in errors.values():
            error.lost = tuple(errors)
        opened = self.group.members.checked(results)
        amplifiers = dict(zip(self.urls, opened, strict=True))
        for observer in self.connected:
            observer(amplifiers)
        await self.group.open()
        for name, amplifier in amplifiers.items():
            self._serial_numbers[name] = amplifier.identity["serial_number"]
            if name in self.amplifiers:
                amplifier.ledger.go_on_from(self.amplifiers[name].ledger)
            self.amplifiers[name] = amplifier
        return amplifiers

    async def _amplifier(self, lines: Lines, name: str) -> Amplifier:
        """Open the line of an amplifier, and send its pending stop, if any.

        Keeps an amplifier whose line is still open from an earlier attempt, with any stop in
        progress. Raises LinkError, CommandError.
        """
        last_amplifier = self._opened.get(name)
        amplifier = last_amplifier
        if amplifier is None or amplifier.line.loss is not None:
            amplifier = await lines.amplifier(
                self.urls[name],
                self._rig.limits,
                name=name,
                serial_number=self._serial_numbers.get(name),
                is_output=name in self._rig.outputs,
            )
            if last_amplifier is not None:
                amplifier.go_on_from(last_amplifier)
        self._opened[name] = amplifier
        self.group.amplifiers[name] = amplifier
        if name in self._pending_stops:
            stopping = _identified([amplifier], self.group.stop(waits_for=[name]))
            self._pending_stops.pop(name).set_result(asyncio.ensure_future(stopping))
        return amplifier

    async def arm(self) -> None:
        """Switch the high voltage on, so that touches are felt; `cycle` must run or start now.

        Raises InputError if an amplifier cannot play the rig any more, as after a change of its
        firmware.
        """
        was_armed = self.group.is_armed
        await self.group.arm()
        try:
            capabilities = playback_capabilities(
                self._rig, self.amplifiers, drive_mode=self.drive_mode
            )
        except InputError:
            await self.group.disarm()
            raise
        self.cycle.note_armed(capabilities, was_armed=was_armed)

    async def disarm(self) -> None:
        """Ramp to silence, then switch the high voltage off."""
        await self.group.disarm()

    def stop(self) -> Coroutine[Any, Any, Mapping[str, StopOutcome]]:
        """Quick-stop all amplifiers on open lines; latched until `clear`; see `Group.stop`."""
        return self.group.stop()

    def stop_all(self) -> Coroutine[Any, Any, Mapping[str, StopOutcome]]:
        """Quick-stop all amplifiers; those with closed lines as soon as their lines are opened.

        The requests on open lines are queued when this returns. Await the result for the outcome
        by amplifier name; it includes replies on lines that are opened within 0.3 s.
        """
        stopping = self.group.stop()
        if self.group.state is GroupState.CLOSED:  # amplifiers on open lines are not identified yet
            amplifiers = self.group.amplifiers.values()
            opened = [amplifier for amplifier in amplifiers if amplifier.line.loss is None]
            stopping = _identified(opened, stopping)
        self._note_closed_lines()
        return self._stopped(asyncio.ensure_future(stopping), dict(self._pending_stops))

    def _note_closed_lines(self) -> None:
        """Register a pending stop for each amplifier with a closed line."""
        for name in self.urls:
            amplifier = self.group.amplifiers.get(name)
            is_closed = amplifier is None or amplifier.line.loss is not None
            if is_closed and name not in self._pending_stops:
                self._pending_stops[name] = asyncio.get_running_loop().create_future()

    async def _stopped(
        self, stopping: _Stopping, pending_stops: Mapping[str, asyncio.Future[_Stopping]]
    ) -> Mapping[str, StopOutcome]:
        """Await a stop and the stops on lines that open soon; return the outcomes by name."""
        if pending_stops:
            await asyncio.wait(pending_stops.values(), timeout=CONFIRM_TIMEOUT)
        outcomes = dict(await stopping)
        self._note_closed_lines()  # of amplifiers lost meanwhile
        for pending_stop in pending_stops.values():
            if pending_stop.done():
                outcomes |= await pending_stop.result()
        return {name: outcomes.get(name, self.what_may_play(name)) for name in self.urls}

    def what_may_play(self, name: str, cause: str = "") -> StopOutcome:
        """Return the possible output of an amplifier; cause: why its state is unknown."""
        opened = self._opened.get(name)
        return UNREACHED if opened is None else opened.what_may_play(cause)

    async def clear(self) -> None:
        """Acknowledge stops and faults without a remaining cause; nothing arms automatically."""
        await self.group.clear()

    async def close(self) -> None:
        """Release the amplifiers and end the cycle."""
        self.cycle.is_closed = True
        self.cycle.wake()
        await self.release()

    async def release(self) -> None:
        """Ramp to zero in 50 ms, confirm it by reading back, disarm and close all lines."""
        lines = self._lines  # the current lines: others can be opened meanwhile
        if lines is not None:
            lines.is_closing = True
        try:
            await self.group.close(CLOSING_RAMP)
        finally:
            try:
                if lines is not None:
                    await lines.close()
            finally:
                if self._lines is lines:
                    self._lines = None


async def _identified(
    amplifiers: Sequence[Amplifier], stopping: _Stopping
) -> Mapping[str, StopOutcome]:
    """Await a stop while identifying amplifiers: unknown amplifiers confirm nothing."""
    for amplifier in amplifiers:
        amplifier.identification.forget()
    requests = [amplifier.identify(timeout=REPLY_TIMEOUT) for amplifier in amplifiers]
    identifying = asyncio.gather(*requests, return_exceptions=True)
    try:
        return await stopping
    finally:
        identifying.cancel()

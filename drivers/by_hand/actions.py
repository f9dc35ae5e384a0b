"""One amplifier by hand: the actions of `era amp`, and `BlockingAmplifier` for scripts.

    with BlockingAmplifier("serial:///dev/ttyUSB0", limits=GuardLimits(40, 500, 0.5)) as amplifier:
        amplifier.arm()
        tone = AmplifierTone(channel=0, frequency=110, level=0.2)
        amplifier.play([AmplifierLayer(0, (tone,))], duration=0.5)

Each action returns the rows of its result, with units in the names of keys. Only `play`, while it
waits, and `heartbeat` feed the watchdog: the amplifier of a script that hangs falls silent.
"""

import asyncio
import contextlib
import math
import shlex
from collections.abc import Sequence
from contextlib import AsyncExitStack
from dataclasses import replace
from types import TracebackType
from typing import Any

from drivers.by_hand.reaching import identified, keep_alive, random_session, reached
from drivers.by_hand.rows import (
    capability_rows,
    fault_rows,
    in_units,
    silence_rows,
    status_rows,
    wire_rows,
)
from drivers.errors import CommandError, CommandRefused, DriverError, LinkError
from drivers.host.amplifier import WATCHDOG, Amplifier
from drivers.host.requests import Priority
from drivers.host.set_admission import StagedSet
from drivers.host.stops import StopOutcome
from drivers.playing import AmplifierLayer, AmplifierTone
from drivers.protocol.definition import (
    BOOT_TIME,
    COMMAND,
    FAULTS,
    HEARTBEAT,
    LATCHED,
    QUANTITIES,
    STATES,
    STOP_RAMP,
    check_watchdog,
    has_feature,
    name_of,
)
from drivers.protocol.records import Values, bits_of
from drivers.protocol.sets import token_after
from drivers.wires.wire import with_address
from registry import threads
from registry.limits import GuardLimits
from registry.threads import LoopThread

_TAKING_ADDRESS = 0.1  # s; until an amplifier replies at its new address
_STOP_TIMEOUT = 2.0  # s
_STOP_INTERVAL = 1.0  # s; of stops while it is identified, which they cut short
_RAMP = 0.05  # s; neither start nor end of a drive clicks
_TOKEN = 1
_MAX_PHASE_ERROR = 5.0  # degrees, between channels that play one frequency together
_UNKNOWN = "it is unknown when its watchdog was fed last: switch it off"


async def identify_amplifier(url: str) -> dict[str, Any]:
    """Read identity, capabilities and wire times."""
    async with identified(url) as amplifier:
        identity = {**amplifier.identity}
        versions = identity.pop("versions")
        return {
            "url": url,
            **identity,
            "versions": bits_of(versions),
            **capability_rows(amplifier.capabilities),
            **wire_rows(amplifier),
        }


async def status(url: str) -> dict[str, Any]:
    """Read status, faults and link timing."""
    async with identified(url) as amplifier:
        present = await amplifier.read_status()
        faults = await amplifier.request("GetFaults", {})
        measured = [
            {"voltage_v": voltage, "current_a": current}
            for voltage, current in await read_electrical(amplifier)
        ]
        return {
            "url": url,
            **status_rows(present),
            "measured": measured,
            "faults": fault_rows(faults),
            "last_round_trip_s": amplifier.counts.last_round_trip,
            **wire_rows(amplifier),
        }


async def read_electrical(amplifier: Amplifier) -> list[tuple[float, float]]:
    """Read voltage [V] and current [A] of each channel; empty if it does not measure them."""
    if not has_feature(amplifier.ledger.capabilities, "electrical"):
        return []
    reply = await amplifier.request("GetMeasured", {}, Priority.READING)
    readings = []
    for row in reply["channels"]:
        voltage = QUANTITIES["channel_voltage"].from_wire(row["channel_voltage"])
        current = QUANTITIES["channel_current"].from_wire(row["channel_current"])
        readings.append((voltage, current))
    return readings


async def stop(url: str) -> dict[str, Any]:
    """Stop all channels; the amplifier is identified after the first Stop.

    Without a confirmation it is unknown until when it may play: another host may feed it.
    """
    rows: dict[str, Any] = {}
    try:
        async with reached(url) as amplifier:
            cause = await _stop(amplifier)
            if amplifier.status is not None:
                rows = status_rows(amplifier.status)
    except LinkError as error:
        cause = f"{error}; {_UNKNOWN}"
    outcome = StopOutcome(not cause, math.inf, cause)  # another host may feed it
    return {"url": url, **silence_rows(outcome, threads.now()), **rows}


async def _stop(amplifier: Amplifier) -> str:
    """Stop an amplifier immediately and until silence is confirmed; returns why it is not."""
    cause = ""
    until = threads.now() + BOOT_TIME
    identifying: asyncio.Future[Any] | None = None
    while identifying is None or not identifying.done():  # takes long if a board may restart
        with contextlib.suppress(DriverError):
            if threads.now() < until:
                values = {"ramp": amplifier.wire_ramp(STOP_RAMP)}
                await amplifier.request("Stop", values, Priority.STOP)
        if identifying is None:
            identifying = asyncio.ensure_future(amplifier.identify())
        await asyncio.wait([identifying], timeout=_STOP_INTERVAL)
    try:
        identifying.result()
    except DriverError as error:  # its channels are unknown, but the stop continues
        cause = str(error)
    stopped = await amplifier.stop(timeout=_STOP_TIMEOUT)
    if stopped.is_confirmed:
        return ""
    return f"{cause or stopped.cause}; {_UNKNOWN}"


async def set_address(url: str, address: int, serial_number: str | None) -> dict[str, Any]:
    """Change the address of the amplifier at a URL, or of the one with a serial number."""
    new_url = with_address(url, address)
    if serial_number is None:
        async with identified(url) as amplifier:
            serial_number = amplifier.identity["serial_number"]
            if not has_feature(amplifier.capabilities, "address"):
                raise CommandError("the address of this amplifier cannot be set over its wire")
            present = await amplifier.read_status()
            if name_of(STATES, present["state"]) != "SWITCH_ON_DISABLED":
                raise CommandRefused("an address is set while disarmed; disarm the amplifier first")
            await _set_address(amplifier, address, serial_number)
    else:
        async with reached(url) as amplifier:
            # With several at this address, the wrong one may reply first.
            with contextlib.suppress(CommandRefused, LinkError):
                await _set_address(amplifier, address, serial_number)
    await asyncio.sleep(_TAKING_ADDRESS)
    async with identified(new_url, serial_number=serial_number):
        return {"url": new_url, "serial_number": serial_number}


async def _set_address(amplifier: Amplifier, address: int, serial_number: str) -> None:
    values = {"address": address, "serial_number": serial_number}
    await amplifier.request("SetAddress", values)


async def clear(url: str) -> dict[str, Any]:
    """Acknowledge a stop or a fault."""
    async with identified(url) as amplifier:
        return {"url": url, **status_rows(await amplifier.clear())}


async def leave(url: str) -> str:
    """Silence an amplifier whose checks were ended, and clear that; returns how it is left."""
    remedy = f"era amp clear {shlex.quote(url)}"
    try:
        stopped = await stop(url)
        cause = stopped["cause"].removesuffix(f"; {_UNKNOWN}")
        cleared = {} if cause else await clear(url)
    except DriverError as error:
        cause = str(error)
    if cause:
        watchdog = f"{QUANTITIES['watchdog'].high:g} s"
        return (
            f"{url} is not confirmed to be silent: {cause}. Its watchdog silences it within "
            f"{watchdog}, and leaves it in FAULT; once it can be reached: {remedy}"
        )
    sentence = f"{url} is left in {cleared['state']}, fault {cleared['fault']}"
    if cleared["state"] == "SWITCH_ON_DISABLED":
        return f"{sentence}, silent"
    return f"{sentence}; once the cause is gone: {remedy}"


async def drive(
    url: str, channel: int, frequency: float, level: float, duration: float
) -> dict[str, Any]:
    """Drive one channel for a time [s]; ends silent and disarmed."""
    limit = QUANTITIES["valid_for"].high
    if not 0 < duration <= limit:
        raise CommandError(f"--for must be above 0 and at most {limit:g} s, got {duration:g} s")
    async with reached(url) as amplifier:
        await amplifier.open()
        ramp = min(_RAMP, QUANTITIES["ramp"].from_wire(amplifier.capabilities["ramp_max"]))
        tone = AmplifierTone(channel, frequency, level)
        layer = AmplifierLayer(0, (tone,), ramp, duration)
        try:
            amplifier.ledger.admit([layer], threads.now(), delay=0.0)
        except CommandRefused as refused:
            raise CommandError(str(refused)) from refused  # bad input, not a refusal
        lowest = QUANTITIES["watchdog"].from_wire(amplifier.capabilities["watchdog_min"])
        watchdog = max(WATCHDOG, lowest)
        check_watchdog(watchdog, amplifier.exchange_time("Set"))
        await _check_not_latched(amplifier, url)
        try:
            await amplifier.arm(random_session(), watchdog)
            await amplifier.stage(StagedSet([layer]), _TOKEN, now=True)
            achieved = await amplifier.request("GetAchieved", {"layer": layer.number})
            await keep_alive(amplifier, duration, watchdog / 5)
        finally:
            # The watchdog stops an amplifier that cannot be reached.
            if amplifier.may_be_armed:  # leave the amplifier of another host alone
                with contextlib.suppress(DriverError):
                    await amplifier.disarm(_RAMP)
        present = await amplifier.read_status()
    commands = []
    for row in achieved["commands"]:
        commands.append({"channel": row["channel"], **in_units(COMMAND, row)})
    return {"url": url, "achieved": commands, "duration_s": duration, **status_rows(present)}


async def _check_not_latched(amplifier: Amplifier, url: str) -> None:
    """Raise CommandRefused after a stop or a fault that was not cleared."""
    present = await amplifier.read_status()
    if present["state"] in LATCHED:
        state = name_of(STATES, present["state"])
        fault = name_of(FAULTS, present["fault"])
        raise CommandRefused(
            f"the amplifier does not arm: state {state}, fault {fault}; once the cause is gone: "
            f"era amp clear {shlex.quote(url)}"
        )


class BlockingAmplifier:
    """The amplifier at a URL, opened by a `with` block and disarmed at its end.

    Commands beyond the limits are rejected. is_output: whether full level must be the output of a
    linear amplifier (True) or the motion of a stiff source (False); None for either.
    """

    def __init__(self, url: str, *, limits: GuardLimits, is_output: bool | None = None) -> None:
        self._reached = reached(url, limits=limits, is_output=is_output)
        self._opened = AsyncExitStack()
        self._token = 1
        self._name = f"amplifier {url}"

    def __enter__(self) -> "BlockingAmplifier":
        self._loop = LoopThread(self._name)
        self._wait = self._loop.run  # interrupted, it cancels: nothing feeds the watchdog further
        try:
            self._amplifier = self._wait(self._opened.enter_async_context(self._reached))
            self._wait(self._amplifier.open())
        except BaseException:
            self._end()
            raise
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        where: TracebackType | None,
    ) -> None:
        try:
            if self._amplifier.line.loss is None:
                self._wait(self._amplifier.disarm())
        finally:
            self._end()

    @property
    def identity(self) -> dict[str, Any]:
        """Vendor, product, serial number and firmware; versions as bits."""
        return {**self._amplifier.identity}

    @property
    def capabilities(self) -> dict[str, Any]:
        """Frequency range, steps and channels, with the keys of `era amp identify`."""
        return capability_rows(self._amplifier.capabilities)

    def arm(self, watchdog: float = WATCHDOG) -> dict[str, Any]:
        """Switch the high voltage on, level zero; watchdog [s]. Returns the status.

        Raises CommandError if the watchdog is too short or too long, and CommandRefused after a
        stop or a fault that was not cleared.
        """
        return status_rows(self._wait(self._amplifier.arm(random_session(), watchdog)))

    def disarm(self) -> None:
        """Fall silent, then switch the high voltage off."""
        self._wait(self._amplifier.disarm())

    def stop(self) -> None:
        """Quick stop, latched until `clear`; raises CommandRefused if silence is not confirmed."""
        outcome = self._wait(self._stopped())
        if not outcome.is_confirmed:
            raise CommandRefused(f"the amplifier may play: {outcome.cause}")

    def clear(self) -> dict[str, Any]:
        """Acknowledge a stop or a fault; returns the status."""
        return status_rows(self._wait(self._amplifier.clear()))

    def status(self) -> dict[str, Any]:
        """Read state, fault and levels, with the keys of `era amp status`."""
        return status_rows(self._wait(self._amplifier.request("GetStatus", {})))

    def faults(self) -> list[dict[str, Any]]:
        """Read latched and past faults, newest first, with the keys of `era amp status`."""
        return fault_rows(self._wait(self._amplifier.request("GetFaults", {})))

    def heartbeat(self) -> dict[str, Any]:
        """Feed the watchdog; CommandRefused if the amplifier is no longer armed."""
        values = {"session": self._amplifier.session, "rate": 0}
        return status_rows(self._wait(self._amplifier.request("Ping", values, Priority.HEARTBEAT)))

    def apply(self, layers: Sequence[AmplifierLayer]) -> StagedSet:
        """Play only these layers from now on; returns them as rounded for the wire.

        Raises CommandRefused beyond the limits, and CommandError if the amplifier's steps are too
        coarse: its only levels are zero and full level, or a phase would be off by more than 5
        degrees.
        """
        return self._wait(self._applied(layers))

    def play(self, layers: Sequence[AmplifierLayer], *, duration: float) -> StagedSet:
        """Play these layers for a time [s], and feed the watchdog meanwhile.

        Returns when the layers begin to fade along their ramps or endings; the plate is silent
        only after these. Raises CommandRefused if the amplifier stops by itself, or its replies
        contradict requests.
        """
        _require_layers(layers)
        staged = self.apply([replace(layer, valid_for=duration) for layer in layers])
        self._wait(keep_alive(self._amplifier, duration, HEARTBEAT))
        return staged

    async def _applied(self, layers: Sequence[AmplifierLayer]) -> StagedSet:
        _require_layers(layers)
        for layer in layers:
            _check_steps(layer, self._amplifier.capabilities)
        self._token = token_after(self._token)
        numbers = {layer.number for layer in layers}
        all_layers = list(layers)
        for number in range(self._amplifier.capabilities["layers"]):
            if number not in numbers:
                all_layers.append(AmplifierLayer(number))  # silence
        return await self._amplifier.stage(StagedSet(all_layers), self._token, now=True)

    async def _stopped(self) -> StopOutcome:
        return await self._amplifier.stop()

    def _end(self) -> None:
        try:
            self._wait(self._opened.aclose())
        finally:
            self._loop.close()


def _check_steps(layer: AmplifierLayer, capabilities: Values) -> None:
    """Raise CommandError for levels and phases that the amplifier would round away.

    Answers of the drive mode `switched` need no phases.
    """
    level_step = QUANTITIES["level"].from_wire(capabilities["level_step"])
    phase_step = QUANTITIES["phase_step"].from_wire(capabilities["phase_step"])
    first_at: dict[float, AmplifierTone] = {}
    for tone in layer.tones:
        where = f"of channel {tone.channel} in layer {layer.number}"
        if level_step >= 1 and 0 < tone.level < 1:
            raise CommandError(
                f"level {where} must be 0 or 1, got {tone.level:.3g}: this amplifier plays full "
                "level or nothing"
            )
        first = first_at.setdefault(tone.frequency, tone)
        difference = tone.phase - first.phase
        rounded_away = abs(math.remainder(difference, phase_step)) if phase_step else 0.0
        if tone.level and rounded_away > _MAX_PHASE_ERROR:
            raise CommandError(
                f"phase {where} must differ from channel {first.channel} by a multiple of "
                f"{phase_step:g} degrees, the amplifier's step, got {difference:.0f}; compute "
                "answers with drive_mode='switched', which needs no phases"
            )


def _require_layers(layers: object) -> None:
    """Raise CommandError for anything but a sequence of layers."""
    if not isinstance(layers, Sequence) or not all(
        isinstance(layer, AmplifierLayer) for layer in layers
    ):
        raise CommandError(f"layers must be a list of AmplifierLayer, got {type(layers).__name__}")

"""Faults to plant into the simulated amplifier and its far ends, with the checks that find them.

One table, `FAULTS`: what is wrong, which check of `drivers.conformance` must find it, and what is
changed, in a line or two. `UNSEEN` are those that the wire does not show, with the reason.
"""

import asyncio
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

from drivers.codec.payload import Cursor, Malformed, Row
from drivers.codec.serial_line import exchanges as serial_exchanges
from drivers.codec.serial_line import frame as serial_frame
from drivers.codec.serial_line import sets as serial_sets
from drivers.command import CommandSet, DriveCommand
from drivers.conformance import LEVEL
from drivers.protocol.definition import PROTOCOL, WireQuantity
from drivers.protocol.messages import (
    Achieved,
    AmplifierState,
    Apply,
    Arm,
    Clear,
    Commit,
    Disarm,
    Fault,
    FaultList,
    Feature,
    GetFaults,
    GetStatus,
    LoadEnvelope,
    Nak,
    NakCode,
    Ping,
    Stage,
    Status,
)
from planted_bugs import Plant, both, replaced, with_voices, wrapped
from planted_end_faults import END_FAULTS
from planted_fading_faults import FADING_FAULTS
from planted_sensor_faults import SENSOR_FAULTS
from sim.amplifier import amplifier as simulated
from sim.amplifier import channels as channel_outputs
from sim.amplifier import set_store
from sim.amplifier.amplifier import SimulatedAmplifier
from sim.amplifier.channels import Channels
from sim.amplifier.set_store import SetStore
from sim.far_ends import serial_end
from sim.far_ends.can_bus import node as can_node
from sim.far_ends.can_bus import requests as can_requests
from sim.far_ends.can_bus import set_buffer as can_sets
from sim.far_ends.can_bus.requests import RequestHandler
from sim.far_ends.can_bus.set_buffer import SetBuffer
from sim.far_ends.modbus import end as modbus_end
from sim.far_ends.modbus import frames as modbus_frames
from sim.far_ends.modbus import registers as modbus_registers
from sim.far_ends.modbus import unit as modbus_unit
from sim.far_ends.modbus.unit import ModbusUnit
from sim.far_ends.serial_end import SerialEnd
from sim.transport.line import Line
from sim.waveform import FadingTone, ShapedTone

ALL = ("serial", "modbus+tcp", "modbus+rtu", "can+slcan")
SERIAL, MODBUS, CAN = ("serial",), ("modbus+tcp", "modbus+rtu"), ("can+slcan",)
SESSIONS = ("serial", "modbus+tcp", "modbus+rtu")
_Q = PROTOCOL.quantities
_ENABLED = AmplifierState.OPERATION_ENABLED
_WITH_ANY_FLAGS = Row(
    *(_Q.channel, WireQuantity("flags", "u8", 1, "", 0, 255), _Q.frequency, _Q.level, _Q.phase)
)


@dataclass(frozen=True)
class PlantedFault:
    """What is changed, the check that must find it, and on which wires.

    unseen: why no check can find it. level: at which channels must be driven for it.
    """

    check: str
    plant: Plant
    wires: tuple[str, ...] = ALL
    unseen: str = ""
    level: float = LEVEL


def handled(around: Callable[..., Any]) -> Plant:
    """Call `around(handle, amplifier, request, now)` for every request."""
    return wrapped(SimulatedAmplifier, "handle", around)


def reply_of(kind: type[Any], alter: Callable[[Any, Any], dict[str, Any]]) -> Plant:
    """Alter every reply of a kind, knowing the amplifier."""

    def around(handle: Any, amplifier: Any, request: Any, now: float) -> Any:
        reply = handle(amplifier, request, now)
        return replace(reply, **alter(reply, amplifier)) if isinstance(reply, kind) else reply

    return handled(around)


def status_of(alter: Callable[[Status, Any], dict[str, Any]]) -> Plant:
    """Alter every status."""

    def around(status: Any, amplifier: Any, now: float) -> Status:
        found = status(amplifier, now)
        return replace(found, **alter(found, amplifier))

    return wrapped(SimulatedAmplifier, "status", around)


def instead_of(kind: type[Any], alter: Callable[[Any, Any], Any]) -> Plant:
    """Carry out another request, made of one of a kind and the amplifier."""

    def around(handle: Any, amplifier: Any, request: Any, now: float) -> Any:
        return handle(
            amplifier, alter(request, amplifier) if isinstance(request, kind) else request, now
        )

    return handled(around)


def fed_by(is_feeding: Callable[[Any, Any], bool]) -> Plant:
    """Feed the watchdog by requests of which this holds, with their replies."""

    def around(handle: Any, amplifier: Any, request: Any, now: float) -> Any:
        reply = handle(amplifier, request, now)
        if amplifier.state is _ENABLED and is_feeding(request, reply):
            amplifier._last_fed = now
        return reply

    return handled(around)


def not_fed_by(kind: type[Any]) -> Plant:
    """Ignore a kind of request for the watchdog."""

    def around(handle: Any, amplifier: Any, request: Any, now: float) -> Any:
        before, was = amplifier._last_fed, amplifier.state
        reply = handle(amplifier, request, now)
        if isinstance(request, kind) and was is _ENABLED:
            amplifier._last_fed = before
        return reply

    return handled(around)


def before(kind: type[Any], act: Callable[[Any, Any, float], None]) -> Plant:
    """Do something with the amplifier before a request of a kind."""

    def around(handle: Any, amplifier: Any, request: Any, now: float) -> Any:
        amplifier.tick(now)
        if isinstance(request, kind):
            act(amplifier, request, now)
        return handle(amplifier, request, now)

    return handled(around)


def after(kind: type[Any], act: Callable[[Any, Any, float], None]) -> Plant:
    """Do something with the amplifier after a request of a kind; the status is that afterwards."""

    def around(handle: Any, amplifier: Any, request: Any, now: float) -> Any:
        reply = handle(amplifier, request, now)
        if not isinstance(request, kind) or isinstance(reply, Nak):
            return reply
        act(amplifier, request, now)
        return amplifier.status(now) if isinstance(reply, Status) else reply

    return handled(around)


def due(change: Callable[[Any, float], float]) -> Plant:
    """Move the time at which the watchdog trips."""
    original = SimulatedAmplifier._watchdog_end

    def moved_end(amplifier: Any) -> float:
        end: float = original.__get__(amplifier)
        return end if end == float("inf") else change(amplifier, end)

    return both(
        replaced(SimulatedAmplifier, "_watchdog_end", property(moved_end)),
        status_of(
            lambda one, self: {"watchdog_left": min(max(0.0, one.watchdog_left), self._watchdog)}
        ),
    )


def played(change: Callable[[CommandSet], CommandSet]) -> Plant:
    """Play another set than is reported."""

    def around(play: Any, channels: Any, playable: Any, time: float) -> None:
        play(channels, replace(playable, command_set=change(playable.command_set)), time)

    return wrapped(Channels, "play", around)


def each(
    change: Callable[[DriveCommand], DriveCommand | None],
) -> Callable[[CommandSet], CommandSet]:
    """Change, or leave out, each command of a set."""

    def changed(wanted: CommandSet) -> CommandSet:
        commands = (change(command) for command in wanted.commands)
        return replace(wanted, commands=tuple(one for one in commands if one is not None))

    return changed


def lying(**stated: Any) -> Plant:
    """State other capabilities than are in force."""

    def around(init: Any, amplifier: Any, *args: Any, **kwargs: Any) -> None:
        init(amplifier, *args, **kwargs)
        amplifier.capabilities = replace(amplifier.capabilities, **stated)

    return wrapped(SimulatedAmplifier, "__init__", around)


def enters(state: AmplifierState, *, instead: AmplifierState) -> Plant:
    """Enter another state."""

    def around(enter: Any, amplifier: Any, entered: Any, moment: float, **how: Any) -> None:
        enter(amplifier, state if entered is instead else entered, moment, **how)

    return wrapped(SimulatedAmplifier, "_enter", around)


def never_refused(kind: type[Any], state: AmplifierState) -> Plant:
    """Let a request through in a state in which it is not allowed."""

    def around(following: Any, present: Any, request: type[Any]) -> Any:
        return _ENABLED if (present, request) == (state, kind) else following(present, request)

    return wrapped(simulated, "next_state", around)


def silenced(change: Callable[[float], float]) -> Plant:
    """Change the ramp of what silences the channels."""

    def around(silence: Any, channels: Any, time: float, *, ramp: float) -> None:
        silence(channels, time, ramp=change(ramp))

    return wrapped(Channels, "silence", around)


def levels_of(level: Callable[[Sequence[float]], float]) -> Plant:
    """Make the level of a channel of the magnitudes of its voices that sound, oldest first."""

    def levels(channels: Any, time: float) -> tuple[float, ...]:
        return tuple(
            min(level([one for one in _sizes(output, time) if one > 0] or [0.0]), 1.0)
            for output in channels._outputs
        )

    return replaced(Channels, "levels", levels)


def _sizes(output: Any, time: float) -> list[float]:
    """The magnitudes of the voices of an output."""
    return [abs(tone.amplitude(time)) for tone in output]


def _half_cancelled(levels: Any, channels: Any, time: float) -> tuple[float, ...]:
    added = (sum(_sizes(output, time)) for output in channels._outputs)
    return tuple((one + both) / 2 for one, both in zip(levels(channels, time), added, strict=True))


def _newest_of_one_frequency(levels: Any, channels: Any, time: float) -> tuple[float, ...]:
    return tuple(
        _sizes(output, time)[-1] if len({tone.frequency for tone in output}) == 1 else level
        for output, level in zip(channels._outputs, levels(channels, time), strict=True)
    )


def _onset_goes_on(ended: Any, playing: Any, time: float, *how: Any) -> Any:
    return ended(playing, time, *how) if playing and playing[-1].is_lasting else playing


def _linear(tone: FadingTone, time: float) -> float:
    share = min((time - tone.start) / tone.ramp, 1.0) if tone.ramp else 1.0
    return tone.gain_from + (tone.gain_to - tone.gain_from) * share


def _extends(fade_out: Any, tone: Any, time: float, *, ramp: float) -> Any:
    return tone._replace(start=time, ramp=ramp, gain_from=tone.gain(time), gain_to=0.0)


def _prolongs(fade_out: Any, tone: Any, time: float, *, ramp: float) -> Any:
    return fade_out(tone, time, ramp=ramp)._replace(ramp=ramp)


def _never_shortens(fade_out: Any, tone: Any, time: float, *, ramp: float) -> Any:
    return tone if tone.gain_to == 0 else fade_out(tone, time, ramp=ramp)


def _jumps(fade_out: Any, tone: Any, time: float, *, ramp: float) -> Any:
    return fade_out(tone, time, ramp=ramp)._replace(gain_from=1.0)


def _trips_when_polled(handle: Any, amplifier: Any, request: Any, now: float) -> Any:
    if amplifier.state is _ENABLED and now > amplifier._last_fed + amplifier._watchdog:
        amplifier.trip(Fault.WATCHDOG, now)
    return handle(amplifier, request, now)


def _keeps_unnamed(play: Any, channels: Any, playable: Any, time: float) -> None:
    kept = channels._outputs
    play(channels, playable, time)
    named = {command.channel for command in playable.commands}
    if named:
        channels._outputs = tuple(
            output if number in named else kept[number]
            for number, output in enumerate(channels._outputs)
        )


def _first_channel_only(silence: Any, channels: Any, time: float, *, ramp: float) -> None:
    kept = channels._outputs[1:]
    silence(channels, time, ramp=ramp)
    channels._outputs = (*channels._outputs[:1], *kept)


def _leaves_fades(silence: Any, channels: Any, time: float, *, ramp: float) -> None:
    if any(tone.is_lasting for output in channels._outputs for tone in output):
        silence(channels, time, ramp=ramp)


def _ends_earlier_sets(play: Any, amplifier: Any, playable: Any, now: float) -> Any:
    end = amplifier._vibration_end
    reply = play(amplifier, playable, now)
    amplifier._vibration_end = min(end, amplifier._vibration_end)
    return reply


def _extends_valid_for(handle: Any, amplifier: Any, request: Any, now: float) -> Any:
    reply = handle(amplifier, request, now)
    if isinstance(request, Apply | Commit) and isinstance(reply, Achieved):
        lasts = amplifier._sets.active.command_set.valid_for
        amplifier._vibration_end = now + lasts if lasts else amplifier._vibration_end
    return reply


def _commits_any(commit: Any, store: Any, token: int, now: float) -> Any:
    return commit(store, store.staged.token if store.staged else token, now)


def _keeps_first_stage(stage: Any, store: Any, wanted: Any, now: float, **how: Any) -> Any:
    kept = store.staged
    reply = stage(store, wanted, now, **how)
    store.staged = kept or store.staged
    return reply


def _apply_keeps_staged(handle: Any, amplifier: Any, request: Any, now: float) -> Any:
    kept = amplifier._sets.staged
    reply = handle(amplifier, request, now)
    if isinstance(request, Apply) and isinstance(reply, Achieved):
        amplifier._sets.staged = kept
    return reply


def _discards_staged(handle: Any, amplifier: Any, request: Any, now: float) -> Any:
    reply = handle(amplifier, request, now)
    if isinstance(reply, Nak):
        amplifier._sets.staged = None
    return reply


def _replays(handle: Any, amplifier: Any, request: Any, now: float) -> Any:
    old = amplifier._sets.active
    was = amplifier.state
    reply = handle(amplifier, request, now)
    if isinstance(request, Arm) and old and was is not _ENABLED and isinstance(reply, Status):
        amplifier._channels.play(old, now)
        return amplifier.status(now)
    return reply


def _plays_the_rest(handle: Any, amplifier: Any, request: Any, now: float) -> Any:
    reply = handle(amplifier, request, now)
    if isinstance(request, Apply) and isinstance(reply, Nak) and amplifier.state is _ENABLED:
        good = each(lambda one: one if one.channel < amplifier.capabilities.channels else None)
        handle(amplifier, replace(request, command_set=good(_plain(request.command_set))), now)
    return reply


def _plain(wanted: CommandSet) -> CommandSet:
    return CommandSet(wanted.token, wanted.commands, wanted.ramp, wanted.valid_for)


def _swapped(command: DriveCommand) -> DriveCommand:
    return replace(command, channel={0: 1, 1: 0}.get(command.channel, command.channel))


def _without_wrap(token: int, than: int) -> bool:
    return token > than


def _oldest_first(reply: FaultList, _: Any) -> dict[str, Any]:
    return {"faults": reply.faults[::-1]}


def _forgets_faults(amplifier: Any, request: Any, now: float) -> None:
    amplifier._faults.clear()


def _without_envelopes(store: Any, wanted: Any) -> Any:
    kept = each(
        lambda one: replace(
            one,
            onset=one.onset if one.onset in store.slots else 0,
            ending=one.ending if one.ending in store.slots else 0,
        )
    )
    return kept(_plain(wanted))


def _late(send: Any, line: Any, frame: bytes) -> None:
    if line._toward == "host":
        asyncio.get_running_loop().call_later(0.025, send, line, frame)
    else:
        send(line, frame)


def _feeds_device(device: Any, now: float) -> None:
    amplifier = device._amplifier
    if amplifier.state is _ENABLED:
        amplifier._last_fed = now


def _feeds_if_malformed(answer: Any, end: Any, frame: Any, device: Any) -> Any:
    reply = answer(end, frame, device)
    if isinstance(reply, Nak):
        _feeds_device(device, asyncio.get_running_loop().time())
    return reply


def _feeds_if_damaged(arrived: Any, end: Any, data: bytes) -> None:
    invalid = end._reader.counters.invalid_frames
    arrived(end, data)
    if end._reader.counters.invalid_frames > invalid:
        _feeds_device(end._first, asyncio.get_running_loop().time())


def _feeds_by_any_byte(arrived: Any, end: Any, data: bytes) -> None:
    arrived(end, data)
    _feeds_device(end._first, asyncio.get_running_loop().time())


class _AnyAddress(int):
    """An address that is every other, too."""

    def __ne__(self, _: object) -> bool:
        return False

    def __eq__(self, _: object) -> bool:
        return True

    __hash__ = int.__hash__


def _answers_any_address(init: Any, end: Any, *args: Any, **how: Any) -> None:
    init(end, *args, **how)
    end._addresses = {name: _AnyAddress(number) for name, number in end._addresses.items()}


def _broadcast_answered(broadcast: Any, end: Any, frame: Any) -> None:
    broadcast(end, frame)
    status = serial_exchanges.encode_reply(
        end._first.status(), frame._replace(kind=PROTOCOL.types["get_status"])
    )
    end._line.outward.send(serial_frame.encode_frame(status))


def _broadcast_obeyed(broadcast: Any, end: Any, frame: Any) -> None:
    end._first.exchange(serial_exchanges.decode_request(frame))


def _unchecked(decode: Any, stuffed: bytes) -> Any:
    found = decode(stuffed)
    if found is None and len(stuffed) > 10:
        content = serial_frame.cobs.decode(stuffed)[:-4]
        return serial_frame.Frame(
            content[0], content[2], int.from_bytes(content[3:5], "little"), content[5:], content[1]
        )
    return found


def _strict_stop(decode: Any, frame: Any) -> Any:
    if frame.payload == b"\xff\xff":
        raise Malformed("ramp out of range", code=NakCode.BAD_VALUE)
    return decode(frame)


def _any_version(decode: Any, frame: Any) -> Any:
    return decode(frame._replace(version=PROTOCOL.version))


def _without_serial_number(init: Any, amplifier: Any, *args: Any, **how: Any) -> None:
    init(amplifier, *args, **how)
    amplifier.identity = replace(amplifier.identity, serial_number="")


class _Forgetful(set[int]):
    """A set that contains nothing."""

    def __contains__(self, _: object) -> bool:
        return False


def _without_repetition(wanted: CommandSet) -> CommandSet:
    last = {command.channel: command for command in wanted.commands}
    return replace(_plain(wanted), commands=tuple(last.values()))


def _to_any_unit(reply: Any, units: Any, request: Any, **how: Any) -> Any:
    return reply(units, replace(request, unit=request.unit and next(iter(units.units))), **how)


def _whole_groups(decode: Any, words: Any) -> Any:
    return decode(words[: len(words) - max(0, len(words) - 5) % 4])


def _any_commit_token(decode: Any, words: Any) -> Any:
    commits = len(words) > 2 and words[0]
    return decode([words[2], *words[1:]] if commits else words)


def _feeds_by_exception(reply: Any, unit: Any, pdu: bytes) -> Any:
    answer = reply(unit, pdu)
    if answer and answer[0] & 0x80:
        _feeds_device(unit._amplifier, asyncio.get_running_loop().time())
    return answer


def _without_exception_1(reply: Any, unit: Any, pdu: bytes) -> Any:
    answer = reply(unit, pdu)
    return None if answer and answer[1:] == b"\x01" and answer[0] & 0x80 else answer


def _without_function_3(reply: Any, unit: Any, pdu: bytes) -> Any:
    return b"\x83\x01" if pdu[0] == 3 else reply(unit, pdu)


def _forgets_halves(feed: Any, reader: Any, data: bytes, now: float) -> Any:
    reader._buffer.clear()
    return feed(reader, data, now)


def _any_heartbeat(receive: Any, node: Any, frame: Any) -> None:
    if frame.id & 0x780 == 0x700:
        node._device.exchange(Ping())
    receive(node, frame)


def _without_sequence(take: Any, handler: Any, data: bytes, **how: Any) -> None:
    take(handler, data[:7] + (data[7:8] if data[7] else b"\x01") + data[8:], **how)


def _short_orders(take: Any, handler: Any, cob_id: int, data: bytes, **how: Any) -> None:
    take(handler, cob_id, data if len(data) > 7 else data.ljust(8, b"\xa5"), **how)


def _masked(take: Any, buffer: Any, channel: int, block: bytes) -> None:
    take(buffer, channel, block[:6] + bytes([block[6] & 0xF7]) + block[7:])


def _by_identifier(take: Any, buffer: Any, channel: int, block: bytes) -> None:
    take(buffer, channel, block[:6] + bytes([block[6] & 0xF | channel << 4]) + block[7:])


def _status_feeds(make: Any, handler: Any, request: Any) -> Any:
    made = make(handler, request)
    return Ping() if isinstance(made, GetStatus) else made


def _any_host(make: Any, handler: Any, request: Any) -> Any:
    if request.action is can_sets.Action.ARM:
        handler._objects.host = request.token
    return make(handler, request)


FAULTS: dict[str, PlantedFault] = {
    # The watchdog
    "the watchdog trips four seconds late": PlantedFault("watchdog", due(lambda _, end: end + 4)),
    "the watchdog trips 20 ms late": PlantedFault("watchdog", due(lambda _, end: end + 0.02)),
    "the watchdog trips 10 ms late": PlantedFault("watchdog_times", due(lambda _, end: end + 0.01)),
    "the watchdog trips a tenth early": PlantedFault(
        "watchdog_times", due(lambda self, end: end - 0.1 * self._watchdog)
    ),
    "the watchdog never trips": PlantedFault("watchdog", due(lambda *_: float("inf"))),
    "the watchdog is of 250 ms whatever Arm says": PlantedFault(
        "watchdog", instead_of(Arm, lambda arm, _: replace(arm, watchdog=0.25))
    ),
    "the watchdog is of one second at most": PlantedFault(
        "watchdog_times", due(lambda self, end: min(end, self._last_fed + 1.0))
    ),
    "the watchdog trips when it is polled": PlantedFault(
        "watchdog_without_reading",
        both(due(lambda *_: float("inf")), handled(_trips_when_polled)),
    ),
    "the watchdog fades along 100 ms": PlantedFault(
        "watchdog", replaced(simulated, "SILENCING_RAMP", 0.1)
    ),
    "the watchdog silences the first channel": PlantedFault(
        "watchdog", wrapped(Channels, "silence", _first_channel_only)
    ),
    "the watchdog leaves the high voltage on": PlantedFault(
        "watchdog",
        status_of(lambda one, _: {"high_voltage": one.high_voltage or one.fault is Fault.WATCHDOG}),
    ),
    "the watchdog does not latch": PlantedFault(
        "watchdog", enters(AmplifierState.SWITCH_ON_DISABLED, instead=AmplifierState.FAULT)
    ),
    "GetStatus feeds the watchdog": PlantedFault(
        "trips_amid_other_requests", fed_by(lambda request, _: isinstance(request, GetStatus))
    ),
    "GetFaults feeds the watchdog": PlantedFault(
        "what_does_not_feed", fed_by(lambda request, _: isinstance(request, GetFaults))
    ),
    "refused sets feed the watchdog": PlantedFault(
        "what_does_not_feed",
        fed_by(lambda request, reply: isinstance(request, Apply) and isinstance(reply, Nak)),
    ),
    "whatever is refused feeds the watchdog": PlantedFault(
        "trips_amid_other_requests", fed_by(lambda _, reply: isinstance(reply, Nak))
    ),
    "a Clear feeds the watchdog": PlantedFault(
        "what_does_not_feed", fed_by(lambda request, _: isinstance(request, Clear))
    ),
    "Ping does not feed the watchdog": PlantedFault("what_feeds", not_fed_by(Ping)),
    "Stage does not feed the watchdog": PlantedFault("what_feeds", not_fed_by(Stage)),
    "Commit does not feed the watchdog": PlantedFault("what_feeds", not_fed_by(Commit)),
    "the same Arm does not feed the watchdog": PlantedFault(
        "what_feeds", not_fed_by(Arm), wires=SESSIONS
    ),
    "the same Arm keeps the time of the first": PlantedFault(
        "arms_again",
        instead_of(
            Arm,
            lambda arm, self: (
                replace(arm, watchdog=self._watchdog) if self.state is _ENABLED else arm
            ),
        ),
    ),
    "the same Arm silences": PlantedFault(
        "arms_again", before(Arm, lambda self, _, now: self._silence(now, ramp=0.0))
    ),
    "watchdog_left is frozen": PlantedFault(
        "watchdog_left",
        status_of(lambda one, self: {"watchdog_left": self._watchdog if one.watchdog_left else 0}),
    ),
    # Sessions
    "any session feeds the watchdog": PlantedFault(
        "sessions",
        instead_of(Ping, lambda ping, self: replace(ping, session=self.session)),
        wires=SESSIONS,
    ),
    "any session plays": PlantedFault(
        "sessions",
        instead_of(Apply, lambda apply, self: replace(apply, session=self.session)),
        wires=SESSIONS,
    ),
    "any session commits": PlantedFault(
        "sessions",
        instead_of(Commit, lambda commit, self: replace(commit, session=self.session)),
        wires=SESSIONS,
    ),
    "a refused session feeds the watchdog": PlantedFault(
        "sessions",
        fed_by(lambda _, reply: isinstance(reply, Nak) and reply.code.name == "WRONG_SESSION"),
        wires=SESSIONS,
    ),
    "a session that has ended arms again": PlantedFault(
        "sessions",
        before(
            Arm,
            lambda self, _, now: setattr(self, "session", self.session * (self.state is _ENABLED)),
        ),
        wires=SESSIONS,
    ),
    # Channels
    "only the first channel plays": PlantedFault(
        "every_channel", played(each(lambda one: one if one.channel == 0 else None))
    ),
    "the last channel is silent": PlantedFault(
        "every_channel", played(each(lambda one: one if one.channel < 3 else None))
    ),
    "the first channels are swapped": PlantedFault("every_channel", played(each(_swapped))),
    "every channel plays the level of the first": PlantedFault(
        "every_channel",
        played(
            lambda wanted: replace(
                wanted,
                commands=tuple(
                    replace(one, level=wanted.commands[0].level) for one in wanted.commands
                ),
            )
        ),
    ),
    "channels that are not named play on": PlantedFault(
        "unnamed_channels", wrapped(Channels, "play", _keeps_unnamed)
    ),
    "levels are a tenth lower than achieved": PlantedFault(
        "achieved", played(each(lambda one: replace(one, level=0.9 * one.level)))
    ),
    "Achieved reports one frequency for all": PlantedFault(
        "achieved_of_every_channel",
        reply_of(
            Achieved,
            lambda reply, _: {
                "commands": tuple(
                    replace(one, frequency=reply.commands[0].frequency) for one in reply.commands
                )
            },
        ),
        wires=("serial", "modbus+tcp", "modbus+rtu", "can+slcan"),
    ),
    "levels show the end of a ramp at once": PlantedFault(
        "ramp_up",
        replaced(
            Channels,
            "levels",
            lambda self, time: tuple(
                sum(abs(tone.settled_amplitude) for tone in output) for output in self._outputs
            ),
        ),
    ),
    "an armed amplifier reports a level too few": PlantedFault(
        "every_channel",
        status_of(lambda one, self: {"levels": one.levels[: -1 if one.high_voltage else None]}),
    ),
    "its list of faults is empty": PlantedFault(
        "watchdog_without_reading", reply_of(FaultList, lambda reply, _: {"faults": ()})
    ),
    # Ramps and phases
    "fades are linear": PlantedFault("ramp_up", replaced(FadingTone, "gain", _linear)),
    "ramps are ignored": PlantedFault("ramp_up", played(lambda one: replace(one, ramp=0.0))),
    "ramps take twice their time": PlantedFault(
        "ramp_up", played(lambda one: replace(one, ramp=2 * one.ramp))
    ),
    "silent sets are abrupt": PlantedFault(
        "ramp_down",
        played(lambda one: one if any(c.level for c in one.commands) else replace(one, ramp=0.0)),
    ),
    "ramps take half a second at most": PlantedFault(
        "ramps_of_other_lengths", played(lambda one: replace(one, ramp=min(one.ramp, 0.5)))
    ),
    "an interrupted fade begins at its full level": PlantedFault(
        "interrupted_ramps", wrapped(FadingTone, "fade_out", _jumps)
    ),
    "a set prolongs an earlier fade": PlantedFault(
        "earlier_ends_stay", wrapped(FadingTone, "fade_out", _extends)
    ),
    "a voice beyond those stated is played": PlantedFault(
        "voices", replaced(Channels, "without_room", lambda *_: None)
    ),
    "two voices are stated, and a third is played": PlantedFault(
        "voices", with_voices(3, stated=2)
    ),
    "four voices are stated, and a third is refused": PlantedFault(
        "voices", with_voices(2, stated=4)
    ),
    "many voices are stated, and a third is refused": PlantedFault(
        "voices", with_voices(2, stated=255)
    ),
    "keep phase is ignored": PlantedFault(
        "phases", played(each(lambda one: replace(one, keep_phase=False)))
    ),
    "phases are always kept": PlantedFault(
        "phases", played(each(lambda one: replace(one, keep_phase=True)))
    ),
    "phases are negated": PlantedFault(
        "phases", played(each(lambda one: replace(one, phase=-one.phase)))
    ),
    "phases are ignored": PlantedFault("phases", played(each(lambda one: replace(one, phase=0.0)))),
    # Levels of cross-fades
    "a channel shows the level of its newest voice alone": PlantedFault(
        "levels_of_two_frequencies", levels_of(lambda sizes: sizes[-1])
    ),
    "a channel shows the level of its loudest voice alone": PlantedFault(
        "levels_of_two_frequencies", levels_of(max)
    ),
    "levels of voices are added as powers": PlantedFault(
        "levels_of_two_frequencies", levels_of(lambda sizes: math.hypot(*sizes))
    ),
    "a cross-fade shows a tenth more than its voices": PlantedFault(
        "levels_of_two_frequencies",
        levels_of(lambda sizes: sum(sizes) * (1.1 if len(sizes) > 1 else 1.0)),
    ),
    "a cross-fade shows half of what one frequency cancels": PlantedFault(
        "levels_of_one_frequency", wrapped(Channels, "levels", _half_cancelled)
    ),
    "voices of one frequency show the newest alone": PlantedFault(
        "levels_of_one_frequency", wrapped(Channels, "levels", _newest_of_one_frequency)
    ),
    # valid_for
    "valid_for is ignored": PlantedFault(
        "valid_for", before(object, lambda self, *_: setattr(self, "_vibration_end", float("inf")))
    ),
    "valid_for is a fifth short": PlantedFault(
        "valid_for",
        instead_of(
            Apply,
            lambda apply, _: replace(
                apply,
                command_set=replace(
                    _plain(apply.command_set), valid_for=0.8 * apply.command_set.valid_for
                ),
            ),
        ),
    ),
    "valid_for is 7 ms long": PlantedFault(
        "valid_for",
        instead_of(
            Apply,
            lambda apply, _: replace(
                apply,
                command_set=replace(
                    _plain(apply.command_set),
                    valid_for=apply.command_set.valid_for
                    + 0.007 * (apply.command_set.valid_for > 0),
                ),
            ),
        ),
    ),
    "the end of valid_for is abrupt": PlantedFault(
        "ramps_of_valid_for",
        wrapped(Channels, "end", lambda end, self, time: self.silence(time, ramp=0.0)),
    ),
    "valid_for begins anew with the same set": PlantedFault(
        "valid_for_is_of_its_set", handled(_extends_valid_for)
    ),
    "valid_for of an earlier set ends the next": PlantedFault(
        "valid_for_is_of_its_set", wrapped(SimulatedAmplifier, "_play", _ends_earlier_sets)
    ),
    # Tokens
    "older tokens play": PlantedFault(
        "tokens", replaced(set_store, "is_newer_token", lambda *_: True)
    ),
    "a token confirms any contents": PlantedFault(
        "tokens",
        replaced(
            SetStore,
            "is_repeated",
            lambda self, wanted: bool(self.active) and wanted.token == self.token,
        ),
    ),
    "a repeated token plays anew": PlantedFault(
        "valid_for",
        before(Apply, lambda self, *_: setattr(self._sets, "active", None)),
    ),
    "tokens do not wrap": PlantedFault(
        "tokens_wrap", replaced(set_store, "is_newer_token", _without_wrap)
    ),
    "a Commit plays what is staged, whatever its token": PlantedFault(
        "stage_and_commit", wrapped(SetStore, "staged_as", _commits_any)
    ),
    "Stage plays": PlantedFault(
        "stage_and_commit",
        instead_of(Stage, lambda stage, _: Apply(stage.command_set, stage.session)),
    ),
    "staged sets never expire": PlantedFault(
        "staged_sets_expire",
        before(Commit, lambda self, _, now: setattr(self._sets, "_staged_at", now)),
    ),
    "staged sets expire after half a second": PlantedFault(
        "staged_sets_expire", replaced(set_store, "PROTOCOL", replace(PROTOCOL, staged_life=0.5))
    ),
    "a second Stage is ignored": PlantedFault(
        "second_stage", wrapped(SetStore, "stage", _keeps_first_stage)
    ),
    "an Apply keeps the staged set": PlantedFault("second_stage", handled(_apply_keeps_staged)),
    "a refusal discards the staged set": PlantedFault("all_or_nothing", handled(_discards_staged)),
    "a refused set plays as far as possible": PlantedFault(
        "all_or_nothing", handled(_plays_the_rest), wires=("serial",)
    ),
    "Arm keeps the staged set": PlantedFault(
        "arming_forgets",
        both(
            replaced(SetStore, "forget", lambda self: setattr(self, "active", None)),
            wrapped(
                SimulatedAmplifier,
                "_silence",
                lambda silence, self, moment, *, ramp: (
                    kept := self._sets.staged,
                    silence(self, moment, ramp=ramp),
                    setattr(self._sets, "staged", kept),
                ),
            ),
        ),
    ),
    "Arm plays the set before": PlantedFault("arming_forgets", handled(_replays)),
    # Stop, Disarm, Clear
    "a Stop does not latch": PlantedFault(
        "quick_stop",
        enters(AmplifierState.SWITCH_ON_DISABLED, instead=AmplifierState.QUICK_STOP_ACTIVE),
    ),
    "a Stop is abrupt": PlantedFault("stop_ramp", silenced(lambda ramp: 0.0)),
    "a Stop takes twice its ramp": PlantedFault("stop_ramp", silenced(lambda ramp: 2 * ramp)),
    "a Stop takes 8 ms longer": PlantedFault(
        "silence_never_later", silenced(lambda ramp: ramp + 0.008)
    ),
    "a Stop takes 100 ms at most": PlantedFault(
        "stop_ramp_clipped", silenced(lambda ramp: min(ramp, 0.1))
    ),
    "a Stop leaves what fades alone": PlantedFault(
        "stop_ends_fades", wrapped(Channels, "silence", _leaves_fades)
    ),
    "a Stop leaves the high voltage on": PlantedFault(
        "quick_stop",
        status_of(
            lambda one, _: {
                "high_voltage": one.high_voltage or one.state is AmplifierState.QUICK_STOP_ACTIVE
            }
        ),
    ),
    "a Stop prolongs a fade": PlantedFault(
        "silence_never_later", wrapped(FadingTone, "fade_out", _extends)
    ),
    "a Stop does not shorten a fade": PlantedFault(
        "silence_never_later", wrapped(FadingTone, "fade_out", _never_shortens)
    ),
    "a stopped amplifier arms": PlantedFault(
        "quick_stop", never_refused(Arm, AmplifierState.QUICK_STOP_ACTIVE)
    ),
    "an amplifier in FAULT arms": PlantedFault(
        "watchdog", never_refused(Arm, AmplifierState.FAULT)
    ),
    "a disarmed amplifier plays": PlantedFault(
        "plays_nothing_disarmed", never_refused(Apply, AmplifierState.SWITCH_ON_DISABLED)
    ),
    "Clear acknowledges any stop": PlantedFault(
        "clear_names_the_stop", instead_of(Clear, lambda _, self: Clear(self.latch))
    ),
    "Clear works amid a ramp": PlantedFault(
        "clear_too_early", before(Clear, lambda self, _, now: setattr(self, "_silent_from", now))
    ),
    "stops are not numbered": PlantedFault(
        "clear_names_the_stop", replaced(SimulatedAmplifier, "_count_latch", lambda self: None)
    ),
    "faults are not numbered": PlantedFault(
        "fault_list",
        wrapped(
            SimulatedAmplifier,
            "trip",
            lambda trip, self, *args, **how: (
                kept := self.latch,
                trip(self, *args, **how),
                setattr(self, "latch", kept),
            ),
        ),
    ),
    "Disarm keeps the high voltage": PlantedFault(
        "disarm",
        status_of(lambda one, self: {"high_voltage": one.high_voltage or self._sets.token > 0}),
    ),
    "Disarm plays on": PlantedFault("disarm", instead_of(Disarm, lambda *_: GetStatus())),
    "Arm lets a fade go on": PlantedFault(
        "arming_ends_fades",
        wrapped(
            SimulatedAmplifier,
            "_silence",
            lambda silence, self, moment, *, ramp: silence(
                self, moment, ramp=max(ramp, 1.0) if self._sets.active else ramp
            ),
        ),
    ),
    # Identity, capabilities, faults
    "the serial number is empty": PlantedFault(
        "identity",
        wrapped(SimulatedAmplifier, "__init__", _without_serial_number),
    ),
    "frequencies above the highest play": PlantedFault(
        "all_or_nothing", lying(frequency_max=600.0)
    ),
    "frequencies below the lowest play": PlantedFault("all_or_nothing", lying(frequency_min=40.0)),
    "levels above the highest play": PlantedFault("all_or_nothing", lying(level_max=0.5)),
    "ramps above the longest are taken": PlantedFault("all_or_nothing", lying(ramp_max=0.5)),
    "the longest watchdog is refused": PlantedFault(
        "stated_ranges", instead_of(Arm, lambda arm, _: replace(arm, watchdog=arm.watchdog + 0.1))
    ),
    "steps are finer than stated": PlantedFault("steps_as_stated", lying(frequency_step=2.0)),
    "the highest level is 0": PlantedFault("capabilities", lying(level_max=0.0)),
    "faults are listed oldest first": PlantedFault(
        "fault_list", reply_of(FaultList, _oldest_first)
    ),
    "ages of faults stand still": PlantedFault(
        "fault_list",
        reply_of(
            FaultList,
            lambda reply, _: {"faults": tuple(replace(one, age=0.0) for one in reply.faults)},
        ),
    ),
    "Clear forgets the faults": PlantedFault("fault_list", after(Clear, _forgets_faults)),
    "replies are 25 ms late": PlantedFault(
        "replies_in_time", wrapped(Line, "send", _late), wires=("serial", "modbus+tcp")
    ),
    "events come although none are stated": PlantedFault(
        "events",
        lying(features=simulated.FEATURES & ~Feature.EVENTS),
        wires=("serial", "can+slcan"),
    ),
    "events tell the state before": PlantedFault(
        "events",
        wrapped(
            serial_end,
            "encode_event",
            lambda encode, event, **how: encode(
                replace(event, state=AmplifierState.OPERATION_ENABLED), **how
            ),
        ),
        wires=SERIAL,
    ),
    "a Stop with a long ramp is refused": PlantedFault(
        "stop_ramp_clipped", wrapped(serial_end, "decode_request", _strict_stop), wires=SERIAL
    ),
    # Envelopes
    "onsets are ignored": PlantedFault(
        "onsets",
        wrapped(
            Channels,
            "play",
            lambda play, self, one, time: play(self, replace(one, onsets={}), time),
        ),
    ),
    "endings are ignored": PlantedFault(
        "endings",
        wrapped(
            Channels,
            "play",
            lambda play, self, one, time: play(self, replace(one, endings={}), time),
        ),
    ),
    "an onset to level 0 goes on through a silent set": PlantedFault(
        "endings_amid_onsets", wrapped(channel_outputs, "_ended", _onset_goes_on)
    ),
    "the steps of envelopes are doubled": PlantedFault(
        "onsets",
        wrapped(
            channel_outputs,
            "shape_to",
            lambda shape, *args, step, **how: shape(*args, step=2 * step, **how),
        ),
    ),
    "the phases of knots are ignored": PlantedFault(
        "endings",
        replaced(
            channel_outputs, "_amplitudes", lambda one: tuple(abs(k.phasor) for k in one.knots)
        ),
    ),
    "the flag skip ending is ignored": PlantedFault(
        "skipped_endings", played(each(lambda one: replace(one, skip_ending=False)))
    ),
    "a set prolongs an ending": PlantedFault(
        "interrupted_endings", wrapped(ShapedTone, "fade_out", _prolongs)
    ),
    "a Stop plays the ending": PlantedFault(
        "skipped_endings",
        wrapped(Channels, "silence", lambda silence, self, time, *, ramp: self.end(time)),
    ),
    "the watchdog plays the ending": PlantedFault(
        "watchdog_skips_endings",
        wrapped(
            Channels,
            "silence",
            lambda silence, self, time, *, ramp: (
                self.end(time)
                if self._endings and ramp == 0.005
                else silence(self, time, ramp=ramp)
            ),
        ),
    ),
    "valid_for skips the ending": PlantedFault(
        "endings",
        wrapped(
            Channels,
            "end",
            lambda end, self, time: (setattr(self, "_endings", {}), end(self, time)),
        ),
    ),
    "loading a slot changes what plays": PlantedFault(
        "loaded_while_playing",
        after(
            LoadEnvelope,
            lambda self, load, _: setattr(
                self._channels,
                "_endings",
                {
                    channel: self._sets.slots.get(one.slot, one)
                    for channel, one in self._channels._endings.items()
                },
            ),
        ),
    ),
    "loading a slot changes what is staged": PlantedFault(
        "loaded_while_playing",
        before(
            Commit,
            lambda self, *_: setattr(
                self._sets,
                "staged",
                self._sets.staged and self._sets._with_envelopes(self._sets.staged.command_set),
            ),
        ),
    ),
    "keep phase is ignored by onsets": PlantedFault(
        "kept_phase_onset",
        wrapped(
            channel_outputs,
            "shape_to",
            lambda shape, *args, knots, keep_phase, amplitude, **how: shape(
                *args,
                knots=knots,
                keep_phase=keep_phase and amplitude == 0,
                amplitude=amplitude,
                **how,
            ),
        ),
    ),
    "an empty slot counts as none": PlantedFault(
        "missing_envelopes",
        wrapped(
            SetStore,
            "_with_envelopes",
            lambda made, self, wanted: made(self, _without_envelopes(self, wanted)),
        ),
    ),
    # Frames on serial lines
    "frames with a wrong CRC are carried out": PlantedFault(
        "invalid_frames", wrapped(serial_frame, "_decode_frame", _unchecked), wires=SERIAL
    ),
    "frames to any address are answered": PlantedFault(
        "invalid_frames", wrapped(SerialEnd, "__init__", _answers_any_address), wires=SERIAL
    ),
    "frames that are too long are carried out": PlantedFault(
        "invalid_frames", replaced(Cursor, "end", lambda self: None), wires=SERIAL
    ),
    "flags that are not defined are ignored": PlantedFault(
        "invalid_frames",
        replaced(serial_sets, "_COMMAND", _WITH_ANY_FLAGS),
        wires=SERIAL,
    ),
    "a channel that occurs twice plays": PlantedFault(
        "invalid_frames",
        both(
            lambda patch: patch.setattr(serial_sets, "set", _Forgetful, raising=False),
            instead_of(
                Apply,
                lambda apply, _: replace(apply, command_set=_without_repetition(apply.command_set)),
            ),
        ),
        wires=SERIAL,
    ),
    "any version is understood": PlantedFault(
        "invalid_frames", wrapped(serial_end, "decode_request", _any_version), wires=SERIAL
    ),
    "malformed frames feed the watchdog": PlantedFault(
        "invalid_frames", wrapped(SerialEnd, "_answer", _feeds_if_malformed), wires=SERIAL
    ),
    "damaged frames feed the watchdog": PlantedFault(
        "invalid_frames", wrapped(SerialEnd, "_arrived", _feeds_if_damaged), wires=SERIAL
    ),
    "any byte feeds the watchdog": PlantedFault(
        "invalid_frames_do_not_feed",
        wrapped(SerialEnd, "_arrived", _feeds_by_any_byte),
        wires=SERIAL,
    ),
    "broadcasts are ignored": PlantedFault(
        "broadcasts", replaced(SerialEnd, "_broadcast", lambda *_: None), wires=SERIAL
    ),
    "broadcasts are answered": PlantedFault(
        "broadcasts", wrapped(SerialEnd, "_broadcast", _broadcast_answered), wires=SERIAL
    ),
    "any request may be broadcast": PlantedFault(
        "broadcasts", wrapped(SerialEnd, "_broadcast", _broadcast_obeyed), wires=SERIAL
    ),
    # Frames on Modbus
    "any unit is answered": PlantedFault(
        "invalid_frames", wrapped(modbus_end._Units, "reply", _to_any_unit), wires=MODBUS
    ),
    "flag bits that must be 0 are ignored": PlantedFault(
        "invalid_frames", replaced(modbus_registers, "_KNOWN_FLAGS", 0xFFFF), wires=MODBUS
    ),
    "a set that ends within a channel plays": PlantedFault(
        "invalid_frames", wrapped(modbus_unit, "decode_set", _whole_groups), wires=MODBUS
    ),
    "any commit_token plays": PlantedFault(
        "invalid_frames", wrapped(modbus_unit, "decode_set", _any_commit_token), wires=MODBUS
    ),
    "exceptions feed the watchdog": PlantedFault(
        "invalid_frames", wrapped(ModbusUnit, "reply", _feeds_by_exception), wires=MODBUS
    ),
    "unknown functions are not answered": PlantedFault(
        "invalid_frames", wrapped(ModbusUnit, "reply", _without_exception_1), wires=MODBUS
    ),
    "registers that do not exist read as 0": PlantedFault(
        "invalid_frames", replaced(modbus_unit, "check_range", lambda *_, **__: None), wires=MODBUS
    ),
    "function 3 is missing": PlantedFault(
        "tolerated_frames", wrapped(ModbusUnit, "reply", _without_function_3), wires=MODBUS
    ),
    "frames with a wrong CRC are obeyed": PlantedFault(
        "invalid_frames",
        replaced(
            modbus_frames,
            "_checked",
            lambda frame: (
                modbus_frames.RequestAdu(frame[0], frame[1:-2]) if len(frame) > 3 else None
            ),
        ),
        wires=("modbus+rtu",),
    ),
    "half a frame is never given up": PlantedFault(
        "tolerated_frames",
        replaced(modbus_frames.Reader, "pause", lambda *_: []),
        wires=("modbus+rtu",),
    ),
    "requests in two pieces are dropped": PlantedFault(
        "tolerated_frames",
        wrapped(modbus_frames.Reader, "feed", _forgets_halves),
        wires=("modbus+tcp",),
    ),
    "any write may be broadcast": PlantedFault(
        "broadcasts",
        replaced(ModbusUnit, "handle_broadcast", lambda self, pdu: self.reply(pdu) and None),
        wires=MODBUS,
    ),
    "broadcast writes are ignored": PlantedFault(
        "broadcasts", replaced(ModbusUnit, "handle_broadcast", lambda *_: None), wires=MODBUS
    ),
    # Frames on CAN
    "the heartbeat of any host feeds the watchdog": PlantedFault(
        "invalid_frames", wrapped(can_node.CanNode, "receive", _any_heartbeat), wires=CAN
    ),
    "orders with sequence number 0 are obeyed": PlantedFault(
        "invalid_frames", wrapped(RequestHandler, "_request", _without_sequence), wires=CAN
    ),
    "short orders are obeyed": PlantedFault(
        "invalid_frames", wrapped(RequestHandler, "take", _short_orders), wires=CAN
    ),
    "a flag that is not defined is ignored": PlantedFault(
        "invalid_frames", wrapped(SetBuffer, "take", _masked), wires=CAN
    ),
    "the channel of a command is ignored": PlantedFault(
        "invalid_frames", wrapped(SetBuffer, "take", _by_identifier), wires=CAN
    ),
    "status orders feed the watchdog": PlantedFault(
        "trips_amid_other_requests",
        wrapped(RequestHandler, "_plain_request", _status_feeds),
        wires=CAN,
    ),
    "any host arms an armed amplifier": PlantedFault(
        "invalid_frames", wrapped(RequestHandler, "_plain_request", _any_host), wires=CAN
    ),
    "broadcast orders are ignored": PlantedFault(
        "broadcasts", replaced(RequestHandler, "_broadcast", lambda *_: None), wires=CAN
    ),
    "any order may be broadcast": PlantedFault(
        "broadcasts",
        replaced(
            RequestHandler,
            "_broadcast",
            lambda self, data: self._request(data[:7] + b"\x01", fd=False),
        ),
        wires=CAN,
    ),
    "incomplete sets play": PlantedFault(
        "invalid_frames",
        replaced(SetBuffer, "is_complete", property(lambda self: self.request is not None)),
        wires=CAN,
    ),
    "incomplete sets wait for ever": PlantedFault(
        "invalid_frames", replaced(can_requests, "_INCOMPLETE_LIFE", 3.0), wires=CAN
    ),
    "the order of a set must come last": PlantedFault(
        "frames_in_any_order",
        wrapped(
            RequestHandler,
            "_request",
            lambda take, self, data, **how: (
                self._buffer.is_complete,
                take(self, data, **how),
                self._buffer.is_complete or self._buffer.clear(),
            ),
        ),
        wires=CAN,
    ),
    "outputs vibrate at half the frequency": PlantedFault(
        "readings_of_tones",
        wrapped(
            Channels,
            "play",
            lambda play, self, one, time: play(
                self,
                replace(
                    one,
                    command_set=each(lambda c: replace(c, frequency=c.frequency / 2))(
                        one.command_set
                    ),
                ),
                time,
            ),
        ),
    ),
    **{name: PlantedFault(fault.check, fault.plant) for name, fault in SENSOR_FAULTS.items()},
    **{
        name: PlantedFault(fault.check, fault.plant, wires=fault.wires or ALL, level=fault.level)
        for name, fault in END_FAULTS.items()
    },
    **{
        name: PlantedFault(fault.check, fault.plant, fault.wires)
        for name, fault in FADING_FAULTS.items()
    },
}
"""Faults that the wire shows, by what is wrong."""

UNSEEN: dict[str, PlantedFault] = {
    "the last two channels are exchanged behind their levels": PlantedFault(
        "",
        lambda patch: None,
        wires=(),
        unseen="levels are those of the synthesis, or of the sensors of a channel: an exchanged "
        "cable behind them is seen on the plate only",
    ),
    "all phases are shifted alike": PlantedFault(
        "",
        wrapped(
            Channels,
            "play",
            lambda play, self, one, time: play(
                self,
                replace(
                    one,
                    command_set=each(lambda c: replace(c, phase=c.phase + 90))(one.command_set),
                ),
                time,
            ),
        ),
        wires=(),
        unseen="levels show phases of one channel relative to each other",
    ),
}
"""Faults that the wire does not show, with the reason."""

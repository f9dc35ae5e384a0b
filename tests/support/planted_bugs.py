"""Bugs to plant into the running chain, each with the rule that the witness must find broken.

A bug replaces an attribute of a module or class by a fake, or wraps it.
"""

import asyncio
import functools
import math
import struct
import zlib
from collections.abc import Awaitable, Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, replace
from itertools import count
from types import ModuleType, SimpleNamespace
from typing import Any

import pytest

import drivers.backends.can_bus.backend as can_backend
import witness_scenarios as scenarios
from controller.group import amplifier_group
from controller.group.quick_stops import QuickStops
from controller.group.synchronized_play import SynchronizedPlay
from controller.loop import decision, loop, safe_sets
from controller.loop.decision import Decider
from controller.loop.loop import Controller
from controller.loop.selection import Selector
from controller.sources import contacts
from controller.sources.contacts import ContactTracker
from drivers.amplifier import Amplifier
from drivers.backends.serial_line.backend import SerialBackend
from drivers.codec import payload
from drivers.codec.can_bus import requests
from drivers.codec.modbus import exchanges
from drivers.codec.serial_line import frame as serial_frame
from drivers.codec.serial_line import reports as serial_reports
from drivers.codec.serial_line import sets as serial_sets
from drivers.command import CommandSet, DriveCommand
from drivers.guard import rules
from drivers.guard.record import PlayRecord
from drivers.line import priority
from drivers.line.sender import Sender
from drivers.link.link import Link
from drivers.protocol.definition import PROTOCOL, WireQuantity
from drivers.protocol.messages import (
    AmplifierState,
    Apply,
    Disarm,
    FaultList,
    GetStatus,
    Hello,
    Identity,
    Stage,
    Status,
)
from sim.amplifier import amplifier as simulated
from sim.amplifier.amplifier import SimulatedAmplifier
from sim.amplifier.channels import Channels, PlayableSet
from sim.amplifier.set_store import SetStore
from sim.far_ends.can_bus.objects import ObjectDictionary
from sim.far_ends.can_bus.requests import RequestHandler
from sim.far_ends.can_bus.set_buffer import SetBuffer
from sim.far_ends.serial_end import SerialEnd
from witnessed_chain import Chain

Plant = Callable[[pytest.MonkeyPatch], None]


@dataclass(frozen=True)
class Bug:
    """What is changed, the rule that it breaks, and where that is seen."""

    breaks: str
    plant: Plant
    scenario: Callable[[Chain], Awaitable[None]] = scenarios.day
    wire: str = "serial"
    amplifiers: tuple[str, ...] = ("main",)


def replaced(owner: type | ModuleType, name: str, fake: Any) -> Plant:
    """Put something else in an attribute's place."""
    return lambda patch: patch.setattr(owner, name, fake)


def wrapped(owner: type | ModuleType, name: str, around: Callable[..., Any]) -> Plant:
    """Call `around` with the original and its arguments in the place of a function."""

    def plant(patch: pytest.MonkeyPatch) -> None:
        original = getattr(owner, name)

        @functools.wraps(original)
        def fake(*args: Any, **kwargs: Any) -> Any:
            return around(original, *args, **kwargs)

        patch.setattr(owner, name, fake)

    return plant


def both(first: Plant, second: Plant) -> Plant:
    """Plant two changes that make one bug."""

    def plant(patch: pytest.MonkeyPatch) -> None:
        first(patch)
        second(patch)

    return plant


def with_voices(in_force: int, *, stated: int = 0) -> Plant:
    """Have this number of voices, and state another."""

    def around(init: Any, amplifier: Any, *args: Any, **kwargs: Any) -> None:
        init(amplifier, *args, **{**kwargs, "voices": in_force})
        can = amplifier.capabilities
        amplifier.capabilities = replace(can, voices=stated or in_force)

    return wrapped(SimulatedAmplifier, "__init__", around)


def _swapped(channel: int) -> int:
    return (1, 0, 2)[channel]


def _with_commands(
    command_set: CommandSet, change: Callable[[DriveCommand], DriveCommand]
) -> CommandSet:
    changed = (change(command) for command in command_set.commands)
    return replace(command_set, commands=tuple(sorted(changed, key=lambda one: one.channel)))


def routed(change: Callable[[DriveCommand], DriveCommand]) -> Plant:
    """Change every command that routing makes of a pattern."""

    def around(route: Callable[..., Mapping[str, CommandSet]], *args: Any, **kwargs: Any) -> Any:
        sets = route(*args, **kwargs)
        return {name: _with_commands(wanted, change) for name, wanted in sets.items()}

    return wrapped(safe_sets, "route", around)


def _kept(tracker: ContactTracker, keys: Iterable[Any]) -> tuple[Any, ...]:
    return tuple(tracker._contacts[key] for key in tuple(keys))


lifts_are_dropped = replaced(ContactTracker, "_lift", _kept)


def _keeps_targets(holds: Any, selector: Selector, intent: Any, targets: Any, quiet: Any) -> bool:
    is_going_on = bool(targets and selector._current.targets)
    return is_going_on or holds(selector, intent, targets, quiet)


def _on_the_plate(update: Any, tracker: ContactTracker, frame: Any) -> Any:
    def clip(share: float) -> float:
        return min(max(share, 0.0), 1.0)

    touches = (replace(each, x=clip(each.x), y=clip(each.y)) for each in frame.touches)
    return update(tracker, replace(frame, touches=tuple(touches)))


async def _beats_apart(step: Any, controller: Any) -> None:
    async def beat() -> None:
        while True:
            await asyncio.sleep(loop.HEARTBEAT)
            await controller._group.heartbeat()

    if not hasattr(controller, "beating"):
        controller.beating = asyncio.create_task(beat())
    await step(controller)


async def _sleeps_past_heartbeats(next_cause: Any, controller: Any) -> None:
    due, controller._heartbeat_due = controller._heartbeat_due, math.inf
    try:
        await next_cause(controller)
    finally:
        if controller._heartbeat_due == math.inf:
            controller._heartbeat_due = due


async def _arms_again(clear: Any, controller: Any) -> None:
    await clear(controller)
    await controller._group.arm()


def _deaf_to_one(decide: Any, decider: Decider, now: float) -> Any:
    made = decide(decider, now)
    return None if made is not None and len(made.contacts) == 1 else made


def _wakes_nothing(follow: Any, controller: Any, change: Any) -> None:
    wake, controller._wake = controller._wake, asyncio.Event()
    try:
        follow(controller, change)
    finally:
        controller._wake = wake


_TWO = ("a", "b")

CONTROLLER: dict[str, Bug] = {
    "lifts are dropped": Bug("lift", lifts_are_dropped),
    "the contacts of a dead source stay": Bug(
        "lift", replaced(contacts, "CONTACT_TIMEOUT", 2.0), scenarios.source_dies
    ),
    "channels are swapped in routing": Bug(
        "pattern", routed(lambda one: replace(one, channel=_swapped(one.channel)))
    ),
    "phases are sent in radians": Bug(
        "pattern", routed(lambda one: replace(one, phase=math.radians(one.phase)))
    ),
    "levels are of twice the stroke": Bug(
        "pattern", routed(lambda one: replace(one, level=one.level / 2))
    ),
    "the pattern of the first finger stays": Bug(
        "touch", wrapped(Selector, "_still_fits", _keeps_targets)
    ),
    "fingers beside the plate count": Bug(
        "justified", wrapped(ContactTracker, "update", _on_the_plate), scenarios.touched_beside
    ),
    "the heartbeat comes from a timer": Bug(
        "heartbeat", wrapped(Controller, "step", _beats_apart), scenarios.hung
    ),
    "heartbeats are too rare": Bug("heartbeat", replaced(loop, "HEARTBEAT", 0.2)),
    "heartbeats wait for touches": Bug(
        "heartbeat", wrapped(Controller, "_wait_for_event", _sleeps_past_heartbeats)
    ),
    "a stop reaches one amplifier only": Bug(
        "stop",
        wrapped(
            QuickStops, "__init__", lambda init, self, all_: init(self, dict([*all_.items()][:1]))
        ),
        amplifiers=_TWO,
    ),
    "a set is committed by one amplifier only": Bug(
        "commit",
        wrapped(
            SynchronizedPlay,
            "_starts",
            lambda starts, playback, sets, *others: starts(
                playback, dict(list(sets.items())[:1]), *others
            ),
        ),
        amplifiers=_TWO,
    ),
    "it arms again once it is cleared": Bug(
        "armed", wrapped(Controller, "clear", _arms_again), scenarios.arc
    ),
    "a single finger is not answered": Bug("touch", wrapped(Decider, "decide", _deaf_to_one)),
    "a touch does not wake the loop": Bug("lift", wrapped(Controller, "_follow", _wakes_nothing)),
    "the release takes half a second": Bug("lift", replaced(decision, "RELEASE_RAMP", 0.5)),
    "a lift ends like a fade": Bug(
        "lift",
        both(
            replaced(decision, "FADE_RAMP", 0.3),
            wrapped(
                Decider,
                "_end",
                lambda ending, decider, left, **how: ending(decider, left or ("one",), **how),
            ),
        ),
    ),
}


def _without(rule: Any) -> Plant:
    return lambda patch: patch.setattr(
        rules, "_RULES", tuple(each for each in rules._RULES if each is not rule)
    )


def _nan_as_integer(to_wire: Any, quantity: WireQuantity, value: float) -> int:
    return -0x8000 if math.isnan(value) else to_wire(quantity, value)


def _nan_unrounded(quantise: Any, quantity: WireQuantity, value: float) -> float:
    return value if math.isnan(value) else quantise(quantity, value)


class _AnyChecksum(int):
    """A checksum that equals every other."""

    def __eq__(self, other: object) -> bool:
        return True

    __hash__ = int.__hash__


_unchecked = replaced(
    serial_frame, "zlib", SimpleNamespace(crc32=lambda body: _AnyChecksum(zlib.crc32(body)))
)


def _credited_to_first(received: Any, backend: Any, frame: Any) -> None:
    pending = backend._pending if frame.is_reply else None
    received(backend, frame._replace(sequence=pending.request.sequence) if pending else frame)


async def _sends_at_once(
    _send: Any, _sender: Any, _backend: Any, _priority: Any, attempt: Any
) -> Any:
    return await attempt()


async def _knows_already(ask: Any, link: Link, request: Any, **how: Any) -> Any:
    if isinstance(request, Hello):
        return Identity("", "", "", "", (PROTOCOL.version,))
    return await ask(link, request, **how)


def _without_order(encode: Any, request: Any, **how: Any) -> Any:
    frames = encode(request, **how)
    return frames[:-1] if isinstance(request, Apply | Stage) else frames


def _level_first(pack: Any, command: DriveCommand) -> list[int]:
    frequency, level, *rest = pack(command)
    return [level, frequency, *rest]


DRIVERS: dict[str, Bug] = {
    "the frequency limit is removed": Bug(
        "limits", _without(rules._check_frequencies), scenarios.too_high
    ),
    "the level limit is removed": Bug("limits", _without(rules._check_levels), scenarios.too_loud),
    "the check for NaN is skipped": Bug(
        "garbage",
        both(
            _without(rules._check_finite),
            both(
                wrapped(WireQuantity, "quantise", _nan_unrounded),
                wrapped(WireQuantity, "to_wire", _nan_as_integer),
            ),
        ),
        scenarios.not_a_number,
    ),
    "every set has the same token": Bug("token", replaced(safe_sets, "token_after", lambda _: 1)),
    "levels have 1000 steps": Bug(
        "pattern",
        wrapped(
            serial_sets,
            "_pack_commands",
            lambda pack, commands: pack(
                tuple(replace(one, level=one.level / 10) for one in commands)
            ),
        ),
    ),
    "integers are sent with the high byte first": Bug(
        "garbage",
        replaced(payload, "_LAYOUTS", {code: struct.Struct(">" + code) for code in "BHIh"}),
    ),
    "the host does not check the CRC": Bug("credit", _unchecked, scenarios.damaged_answer),
    "a reply is credited to the first that waits": Bug(
        "credit", wrapped(SerialBackend, "_received", _credited_to_first), scenarios.foreign_answer
    ),
    "two requests are on the line at once": Bug(
        "credit", wrapped(Sender, "send", _sends_at_once), scenarios.slow_touch
    ),
    "a stop is queued behind": Bug(
        "stop", replaced(priority, "PREEMPTION_GRACE", 10.0), scenarios.slow_stop
    ),
    "silence waits its turn": Bug(
        "lift",
        both(
            replaced(priority, "PREEMPTION_GRACE", 10.0),
            replaced(amplifier_group, "PREEMPTION_GRACE", 10.0),
        ),
        scenarios.slow_lift,
    ),
    "sets are not held back": Bug(
        "voices",
        both(with_voices(2), replaced(PlayRecord, "room_from", lambda *_: -math.inf)),
        scenarios.hasty,
    ),
    "it has fewer voices than it states": Bug("voices", with_voices(2, stated=4), scenarios.hasty),
    "a stop is sent as a disarm": Bug("stop", replaced(Amplifier, "stop", Amplifier.disarm)),
    "no amplifier is identified": Bug("identified", wrapped(Link, "request", _knows_already)),
    "sets are sent without their order": Bug(
        "touch", wrapped(can_backend, "encode_request", _without_order), wire="slcan"
    ),
    "a command has the sequence number before": Bug(
        "commit",
        wrapped(
            requests,
            "_command",
            lambda encode, one, sequence: encode(one, sequence - (one.channel == 1)),
        ),
        wire="socketcand",
    ),
    "the frame of a channel has its neighbour's identifier": Bug(
        "garbage",
        wrapped(
            requests, "command_id", lambda id_of, node, channel: id_of(node, _swapped(channel))
        ),
        wire="slcan",
    ),
    "registers of channels begin with the level": Bug(
        "limits", wrapped(exchanges, "_pack_channel", _level_first), wire="modbus-rtu"
    ),
}

_watchdog_end: Any = SimulatedAmplifier._watchdog_end


def _watchdog_ends(change: Callable[[float], float]) -> Plant:
    changed = property(lambda amplifier: change(_watchdog_end.fget(amplifier)))
    return replaced(SimulatedAmplifier, "_watchdog_end", changed)


def _reports(change: Callable[[Status], Status]) -> Plant:
    return wrapped(
        SimulatedAmplifier, "status", lambda status, amplifier, now: change(status(amplifier, now))
    )


def _lists(change: Callable[[Any], Any]) -> Plant:
    def around(carry_out: Any, amplifier: Any, request: Any, *rest: Any) -> Any:
        reply = carry_out(amplifier, request, *rest)
        if isinstance(reply, FaultList):
            return replace(reply, faults=change(reply.faults))
        return reply

    return wrapped(SimulatedAmplifier, "_carry_out", around)


def _identifies(change: Callable[[Identity], Identity]) -> Plant:
    def around(carry_out: Any, amplifier: Any, request: Any, *rest: Any) -> Any:
        reply = carry_out(amplifier, request, *rest)
        return change(reply) if isinstance(reply, Identity) else reply

    return wrapped(SimulatedAmplifier, "_carry_out", around)


def _reads(index: int, subindex: int, value: Callable[[Iterator[int]], bytes]) -> Plant:
    """Let an object over CAN read as another value; numbers count the reads."""
    numbers = count()

    def around(read: Any, objects: Any, *item: int) -> Any:
        return value(numbers) if item == (index, subindex) else read(objects, *item)

    return wrapped(ObjectDictionary, "read", around)


def _as_another_each_time(identity: Identity, numbers: Iterator[int] = count()) -> Identity:  # noqa: B008
    return replace(identity, firmware=f"1.{next(numbers)}")


def _shrinks(carry_out: Any, amplifier: Any, request: Any, *rest: Any) -> Any:
    if isinstance(request, Disarm):
        less = replace(amplifier.capabilities, ramp_max=0.5)
        amplifier.capabilities = less
    return carry_out(amplifier, request, *rest)


def _enters(wrong: AmplifierState, *, instead_of: AmplifierState) -> Plant:
    def around(
        enter: Any, amplifier: Any, state: AmplifierState, moment: float, **how: Any
    ) -> None:
        enter(amplifier, wrong if state is instead_of else state, moment, **how)

    return wrapped(SimulatedAmplifier, "_enter", around)


def _plays(change: Callable[[CommandSet], CommandSet]) -> Plant:
    def around(play: Any, channels: Channels, playable: PlayableSet, time: float) -> None:
        play(channels, replace(playable, command_set=change(playable.command_set)), time)

    return wrapped(Channels, "play", around)


def _plays_each(change: Callable[[DriveCommand], DriveCommand]) -> Plant:
    return _plays(lambda wanted: _with_commands(wanted, change))


def _on_first_channel(act: Any, channels: Channels, *args: Any, **kwargs: Any) -> None:
    others = channels.outputs[1:]
    act(channels, *args, **kwargs)
    channels._outputs = (*channels.outputs[:1], *others)


def _plays_on(carry_out: Any, amplifier: Any, request: Any, *args: Any) -> Any:
    if not isinstance(request, Disarm):
        return carry_out(amplifier, request, *args)
    amplifier._silence = lambda moment, **_: setattr(amplifier, "_silent_from", moment)
    try:
        return carry_out(amplifier, request, *args)
    finally:
        del amplifier._silence


def _fed_by_status(handle: Any, amplifier: Any, request: Any, now: float) -> Any:
    if isinstance(request, GetStatus):
        amplifier._last_fed = now
    return handle(amplifier, request, now)


def _forgetful(stage: Any, sets: SetStore, *args: Any, **kwargs: Any) -> Any:
    active, sets.active = sets.active, None
    try:
        return stage(sets, *args, **kwargs)
    finally:
        sets.active = active


def _twice(write: Any, end: SerialEnd, data: bytes) -> None:
    write(end, data)
    write(end, data)


def _all_but_the_ninth(write: Any, end: Any, data: bytes) -> None:
    end.writes = getattr(end, "writes", 0) + 1
    if end.writes != 9:
        write(end, data)


def _without_levels(answer: Any, handler: Any, request: Any, **how: Any) -> None:
    answer(handler, request, **{**how, "condition": how.get("condition", ())[:1]})


FAR_ENDS: dict[str, Bug] = {
    "the watchdog is 20 ms late": Bug(
        "watchdog", _watchdog_ends(lambda end: end + 0.02), scenarios.hung
    ),
    "the watchdog is 20 ms early": Bug(
        "watchdog", _watchdog_ends(lambda end: end - 0.02), scenarios.hung
    ),
    "there is no watchdog": Bug("watchdog", _watchdog_ends(lambda _: math.inf), scenarios.hung),
    "a status request feeds the watchdog": Bug(
        "watchdog",
        wrapped(SimulatedAmplifier, "handle", _fed_by_status),
        scenarios.hung,
    ),
    "the time left is reported in hundredths": Bug(
        "watchdog", _reports(lambda one: replace(one, watchdog_left=one.watchdog_left / 10))
    ),
    "a fault is not latched": Bug(
        "latched",
        _enters(AmplifierState.SWITCH_ON_DISABLED, instead_of=AmplifierState.FAULT),
        scenarios.arc,
    ),
    "a stop is not latched": Bug(
        "latched",
        _enters(AmplifierState.SWITCH_ON_DISABLED, instead_of=AmplifierState.QUICK_STOP_ACTIVE),
    ),
    "it arms itself after a fault": Bug(
        "armed",
        _enters(AmplifierState.OPERATION_ENABLED, instead_of=AmplifierState.FAULT),
        scenarios.arc,
    ),
    "a commit reaches one channel only": Bug(
        "commit", wrapped(Channels, "play", _on_first_channel)
    ),
    "channels are swapped in the amplifier": Bug(
        "plays", _plays_each(lambda one: replace(one, channel=_swapped(one.channel)))
    ),
    "a ramp is ignored": Bug("ramp", _plays(lambda wanted: replace(wanted, ramp=0.0))),
    "a stop is abrupt": Bug(
        "ramp",
        wrapped(
            Channels,
            "silence",
            lambda silence, channels, time, ramp: silence(channels, time, ramp=0),
        ),
    ),
    "a disarmed amplifier plays on": Bug(
        "silent", wrapped(SimulatedAmplifier, "_carry_out", _plays_on), scenarios.disarmed_amid
    ),
    "a fault silences one channel only": Bug(
        "silent", wrapped(Channels, "silence", _on_first_channel), scenarios.arc
    ),
    "a stale set is played": Bug(
        "token", wrapped(SetStore, "prepare", _forgetful), scenarios.late_copy
    ),
    "a damaged frame is carried out": Bug("damage", _unchecked, scenarios.noise),
    "the high voltage stays on": Bug(
        "high_voltage",
        _reports(
            lambda one: replace(
                one, high_voltage=one.high_voltage or one.state is AmplifierState.FAULT
            )
        ),
        scenarios.arc,
    ),
    "every answer is sent twice": Bug("credit", wrapped(SerialEnd, "_to_host", _twice)),
    "a request is left unanswered": Bug(
        "answer", wrapped(SerialEnd, "_to_host", _all_but_the_ninth)
    ),
    "its channels vibrate at half the frequency": Bug(
        "plays", _plays_each(lambda one: replace(one, frequency=one.frequency / 2))
    ),
    "it plays a tenth of the level": Bug(
        "plays", _plays_each(lambda one: replace(one, level=one.level / 10))
    ),
    "it reports that nothing plays": Bug(
        "commit", _reports(lambda one: replace(one, levels=(0.0,) * len(one.levels)))
    ),
    "an incomplete set is played": Bug(
        "commit",
        replaced(SetBuffer, "is_complete", property(lambda buffer: buffer.request is not None)),
        scenarios.incomplete_set,
        wire="slcan",
    ),
    "it takes sets while it is disarmed": Bug(
        "enabled",
        replaced(simulated, "next_state", lambda state, request: state),
        scenarios.strangers_set,
    ),
    "it reports that it is only switched on": Bug(
        "state",
        _reports(
            lambda one: (
                replace(one, state=AmplifierState.SWITCHED_ON)
                if one.state is AmplifierState.OPERATION_ENABLED
                else one
            )
        ),
    ),
    "an answer comes without its levels": Bug(
        "answer", wrapped(RequestHandler, "_answer", _without_levels), wire="socketcand"
    ),
    "it obeys any session": Bug(
        "session",
        replaced(SimulatedAmplifier, "_is_foreign", lambda *_: False),
        scenarios.strangers_heartbeat,
    ),
    "its list of faults is empty": Bug(
        "faults", _lists(lambda faults: ()), scenarios.asked, wire="serial"
    ),
    "it lists faults older than they are": Bug(
        "faults",
        _lists(lambda faults: tuple(replace(one, age=one.age + 5) for one in faults)),
        scenarios.asked,
        wire="modbus-tcp",
    ),
    "it lists faults oldest first": Bug(
        "faults", _lists(lambda faults: faults[::-1]), scenarios.asked
    ),
    "its identity changes": Bug("constant", _identifies(_as_another_each_time), scenarios.asked),
    "its capabilities change": Bug(
        "constant", wrapped(SimulatedAmplifier, "_carry_out", _shrinks), scenarios.asked
    ),
    "its name is no UTF-8": Bug(
        "answer",
        replaced(serial_reports, "pack_text", lambda text: b"\x02\xff\xfe"),
        scenarios.asked,
    ),
    "its name is no UTF-8 on CAN": Bug(
        "answer",
        _reads(0x2000, 2, lambda numbers: b"\xff\xfe"),
        scenarios.asked,
        wire="slcan",
    ),
    "its firmware changes on CAN": Bug(
        "constant",
        _reads(0x2000, 4, lambda numbers: b"1." + b"1" * next(numbers)),
        scenarios.asked,
        wire="slcan",
    ),
    "its longest ramp changes on CAN": Bug(
        "constant",
        _reads(0x2001, 8, lambda numbers: struct.pack("<H", 1000 - next(numbers))),
        scenarios.asked,
        wire="socketcand",
    ),
    "its list of faults is empty on CAN": Bug(
        "faults", _lists(lambda faults: ()), scenarios.asked, wire="slcan"
    ),
    "it lists faults older than they are on CAN": Bug(
        "faults",
        _lists(lambda faults: tuple(replace(one, age=one.age + 5) for one in faults)),
        scenarios.asked,
        wire="slcan",
    ),
    "it lists half a fault on CAN": Bug(
        "answer", _reads(0x2008, 0, lambda numbers: bytes(9)), scenarios.asked, wire="slcan"
    ),
    "it forgets which set plays": Bug("token", _reports(lambda one: replace(one, token=0))),
}

BUGS = {**CONTROLLER, **DRIVERS, **FAR_ENDS}

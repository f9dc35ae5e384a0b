"""Faults amid fades, of repeats and of numbers that wrap, to plant; see `planted_faults`."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

from drivers.protocol.messages import (
    AmplifierState,
    Apply,
    Arm,
    Commit,
    Nak,
    NakCode,
    Ping,
    Stage,
    Stop,
)
from planted_bugs import Plant, both, replaced, wrapped
from sim.amplifier import amplifier as simulated
from sim.amplifier.amplifier import SimulatedAmplifier
from sim.amplifier.channels import Channels
from sim.amplifier.set_store import SetStore
from sim.bench.simulated_device import SimulatedDevice
from sim.waveform import fade_to

_ENABLED = AmplifierState.OPERATION_ENABLED
_SESSIONS = ("serial", "modbus+tcp", "modbus+rtu")
_ANY = (*_SESSIONS, "can+slcan")


@dataclass(frozen=True)
class FadingFault:
    """What is changed, the check that must find it, and on which wires."""

    check: str
    plant: Plant
    wires: tuple[str, ...] = _ANY


def _handled(around: Any) -> Plant:
    return wrapped(SimulatedAmplifier, "handle", around)


def _watchdog_waits(until: Any) -> Plant:
    """Let the watchdog trip no sooner than a time that the amplifier knows [s]."""
    original = SimulatedAmplifier._watchdog_end

    def end(amplifier: Any) -> float:
        due: float = original.__get__(amplifier)
        return due if due == float("inf") else max(due, until(amplifier))

    def status(shown: Any, amplifier: Any, now: float) -> Any:
        found = shown(amplifier, now)
        return replace(found, watchdog_left=max(0.0, found.watchdog_left))

    return both(
        replaced(SimulatedAmplifier, "_watchdog_end", property(end)),
        wrapped(SimulatedAmplifier, "status", status),
    )


def _ends_of(voices: Any) -> Any:
    """The latest end of the ramps of voices of which this holds [s]."""
    return lambda amplifier: max(
        (
            voice.start + voice.ramp
            for output in amplifier._channels.outputs
            for voice in output
            if hasattr(voice, "gain_to") and voices(voice)
        ),
        default=0.0,
    )


def _newest_only(silence: Any, channels: Any, time: float, *, ramp: float) -> None:
    kept = [output[:-1] for output in channels._outputs]
    channels._outputs = [output[-1:] for output in channels._outputs]
    silence(channels, time, ramp=ramp)
    channels._outputs = [(*old, *new) for old, new in zip(kept, channels._outputs, strict=True)]


def _trip_of_the_newest(trip: Any, amplifier: Any, *args: Any, **how: Any) -> None:
    original = amplifier._channels.silence
    amplifier._channels.silence = lambda time, *, ramp: _newest_only(
        lambda channels, at, *, ramp: original(at, ramp=ramp),
        amplifier._channels,
        time,
        ramp=ramp,
    )
    try:
        trip(amplifier, *args, **how)
    finally:
        del amplifier._channels.silence


def _plays_amid_disarm(following: Any, present: Any, request: type[Any]) -> Any:
    if present is AmplifierState.SWITCHED_ON and request in (Apply, Commit, Stage):
        return present
    return following(present, request)


def _replays_ended(handle: Any, amplifier: Any, request: Any, now: float) -> Any:
    active = amplifier._sets.active
    reply = handle(amplifier, request, now)
    is_repeat = isinstance(request, Commit) and active and active.token == request.token
    if is_repeat and amplifier.state is _ENABLED and not any(amplifier._channels.levels(now)):
        amplifier._channels.play(active, now)
    return reply


def _on_fading(act: Any) -> Plant:
    """Do something at a refusal with FADING."""

    def around(handle: Any, amplifier: Any, request: Any, now: float) -> Any:
        reply = handle(amplifier, request, now)
        if isinstance(reply, Nak) and reply.code is NakCode.FADING:
            act(amplifier, reply.channel, now)
        return reply

    return _handled(around)


def _feeds(amplifier: Any, channel: int, now: float) -> None:
    amplifier._last_fed = now


def _fades_others(amplifier: Any, channel: int, now: float) -> None:
    outputs = amplifier._channels._outputs
    amplifier._channels._outputs = [
        output if number == channel else fade_to(output, now, ramp=0.3)
        for number, output in enumerate(outputs)
    ]


def _drops_staged(amplifier: Any, channel: int, now: float) -> None:
    amplifier._sets.staged = None


def _counts_at_ramp_0(without_room: Any, channels: Any, playable: Any, time: float) -> Any:
    wanted = playable.command_set
    ramp = wanted.ramp or 0.001
    later = replace(playable, command_set=replace(wanted, ramp=ramp))
    return without_room(channels, later, time)


def _signed(play: Any, amplifier: Any, playable: Any, now: float) -> Any:
    reply = play(amplifier, playable, now)
    if playable.command_set.valid_for > 32.767:
        amplifier._vibration_end = now
    return reply


def _whatever_valid_for(repeated: Any, store: Any, wanted: Any) -> Any:
    if store.active is not None:
        wanted = replace(wanted, valid_for=store.active.asked.valid_for)
    return repeated(store, wanted)


def _compares(same: Any) -> Plant:
    """Take sessions for the one that is held where this holds."""

    def around(handle: Any, amplifier: Any, request: Any, now: float) -> Any:
        kinds = Arm | Ping | Stage | Commit | Apply
        if (
            isinstance(request, kinds)
            and amplifier.state is _ENABLED
            and same(request.session, amplifier.session)
        ):
            request = replace(request, session=amplifier.session)
        return handle(amplifier, request, now)

    return _handled(around)


def _wraps_to_zero(count: Any, amplifier: Any) -> None:
    amplifier.latch = (amplifier.latch + 1) % 256


def _of_any_session(broadcast: Any, device: Any, request: Any) -> Any:
    if isinstance(request, Commit):
        request = replace(request, session=device._amplifier.session)
    return broadcast(device, request)


def _without_latch(broadcast: Any, device: Any, request: Any) -> Any:
    amplifier = device._amplifier
    latch = amplifier.latch
    reply = broadcast(device, request)
    if isinstance(request, Stop):
        amplifier.latch = latch
    return reply


FADING_FAULTS: Mapping[str, FadingFault] = {
    "the watchdog waits for the end of valid_for": FadingFault(
        "trips_amid_fades",
        _watchdog_waits(
            lambda one: one._vibration_end if one._vibration_end < float("inf") else 0.0
        ),
    ),
    "the watchdog waits while a level rises": FadingFault(
        "trips_amid_fades", _watchdog_waits(_ends_of(lambda voice: voice.gain_to > 0))
    ),
    "the watchdog waits while a voice fades": FadingFault(
        "trips_amid_fades", _watchdog_waits(_ends_of(lambda voice: voice.gain_to == 0))
    ),
    "the watchdog silences the newest voice only": FadingFault(
        "trips_amid_fades", wrapped(SimulatedAmplifier, "trip", _trip_of_the_newest)
    ),
    "sets are accepted amid a Disarm": FadingFault(
        "disarming_refuses_sets", wrapped(simulated, "next_state", _plays_amid_disarm)
    ),
    "a repeated Commit plays again what has ended": FadingFault(
        "valid_for", _handled(_replays_ended)
    ),
    "a voice too many feeds the watchdog": FadingFault(
        "no_room_changes_nothing", _on_fading(_feeds)
    ),
    "a voice too many fades the other channels": FadingFault(
        "no_room_changes_nothing", _on_fading(_fades_others)
    ),
    "a voice too many drops the staged set": FadingFault(
        "no_room_changes_nothing", _on_fading(_drops_staged)
    ),
    "voices that end at once count": FadingFault(
        "no_room_changes_nothing", wrapped(Channels, "without_room", _counts_at_ramp_0)
    ),
    "valid_for is taken as signed": FadingFault(
        "max_valid_for", wrapped(SimulatedAmplifier, "_play", _signed)
    ),
    "a repeat with another valid_for is confirmed": FadingFault(
        "altered_repeats", wrapped(SetStore, "is_repeated", _whatever_valid_for)
    ),
    "sessions are compared by their low byte": FadingFault(
        "sessions", _compares(lambda one, held: one & 0xFF == held & 0xFF), wires=_SESSIONS
    ),
    "sessions are compared by their high byte": FadingFault(
        "sessions", _compares(lambda one, held: one >> 8 == held >> 8), wires=_SESSIONS
    ),
    "latches wrap to 0": FadingFault(
        "latch_wraps", wrapped(SimulatedAmplifier, "_count_latch", _wraps_to_zero)
    ),
    "a broadcast Commit of any session plays": FadingFault(
        "broadcasts", wrapped(SimulatedDevice, "broadcast", _of_any_session), wires=_SESSIONS
    ),
    "a broadcast Stop is not numbered": FadingFault(
        "broadcasts", wrapped(SimulatedDevice, "broadcast", _without_latch)
    ),
}
"""Each with the check that must find it."""

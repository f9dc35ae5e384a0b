"""Faults at the ends of what an amplifier states, and of its address; see `planted_faults`."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

from drivers.command import DriveCommand, Envelope
from drivers.conformance import LEVEL
from drivers.protocol.messages import AmplifierState, Nak, NakCode, SetAddress
from planted_bugs import Plant, wrapped
from sim.amplifier import amplifier as simulated
from sim.amplifier import channels as channel_outputs
from sim.amplifier.channels import Channels
from sim.amplifier.set_store import SetStore
from sim.bench.simulated_device import SimulatedDevice

_ENABLED = AmplifierState.OPERATION_ENABLED
_SERIAL = ("serial",)


@dataclass(frozen=True)
class EndFault:
    """What is changed, the check that must find it, and on which wires; none: on all.

    level: at which channels must be driven for it.
    """

    check: str
    plant: Plant
    wires: tuple[str, ...] = ()
    level: float = LEVEL


def _loaded(change: Any) -> Plant:
    """Store another envelope than is loaded."""

    def around(load: Any, store: Any, envelope: Envelope) -> Any:
        reply = load(store, change(envelope))
        return replace(reply, slot=envelope.slot, knots=len(envelope.knots))

    return wrapped(SetStore, "load", around)


def _played(change: Any) -> Plant:
    """Play other commands than are reported."""

    def around(play: Any, channels: Channels, playable: Any, time: float) -> None:
        wanted = playable.command_set
        commands = tuple(change(command) for command in wanted.commands)
        play(channels, replace(playable, command_set=replace(wanted, commands=commands)), time)

    return wrapped(Channels, "play", around)


def _half_above(frequency: float) -> Any:
    def change(one: DriveCommand) -> DriveCommand:
        return replace(one, level=one.level / 2) if one.frequency > frequency else one

    return change


def _conjugate(one: DriveCommand) -> DriveCommand:
    return replace(one, phase=-one.phase) if one.channel == 2 and not one.onset else one


def _unturned(one: DriveCommand) -> DriveCommand:
    return replace(one, phase=0.0) if one.keep_phase and not one.onset else one


def _keeps_any_frequency(shape_to: Any, playing: Any, time: float, **how: Any) -> Any:
    if how["keep_phase"] and playing:
        playing = (*playing[:-1], playing[-1]._replace(frequency=how["frequency"]))
    return shape_to(playing, time, **how)


def _for_anybody(exchange: Any, device: SimulatedDevice, request: Any) -> Any:
    if isinstance(request, SetAddress):
        request = replace(request, serial_number=device.identity.serial_number)
    return exchange(device, request)


def _refuses_others(exchange: Any, device: SimulatedDevice, request: Any) -> Any:
    reply = exchange(device, request)
    is_silent = reply is None and isinstance(request, SetAddress)
    return Nak(NakCode.BAD_VALUE) if is_silent else reply


END_FAULTS: Mapping[str, EndFault] = {
    "the address can be set while armed": EndFault(
        "addresses",
        wrapped(
            simulated,
            "next_state",
            lambda following, state, request: (
                state if (state, request) == (_ENABLED, SetAddress) else following(state, request)
            ),
        ),
    ),
    "the address is set by any serial number": EndFault(
        "addresses", wrapped(SimulatedDevice, "exchange", _for_anybody)
    ),
    "SetAddress of another serial number is refused with a reply": EndFault(
        "addresses", wrapped(SimulatedDevice, "exchange", _refuses_others), wires=_SERIAL
    ),
    "outputs are limited to 30 % of full stroke": EndFault(
        "levels_of_every_frequency",
        _played(lambda one: replace(one, level=min(one.level, 0.3))),
        level=0.5,
    ),
    "high frequencies are played at half their level": EndFault(
        "levels_of_every_frequency", _played(_half_above(300.0))
    ),
    "envelopes are cut after eight knots": EndFault(
        "max_knots", _loaded(lambda one: replace(one, knots=one.knots[:8]))
    ),
    "envelopes move by two knots only": EndFault(
        "max_knots", _loaded(lambda one: replace(one, knots=one.knots[:2]))
    ),
    "steps of envelopes are 50 ms at least": EndFault(
        "extreme_steps", _loaded(lambda one: replace(one, step=max(one.step, 0.05)))
    ),
    "steps of envelopes are 50 ms at most": EndFault(
        "extreme_steps", _loaded(lambda one: replace(one, step=min(one.step, 0.05)))
    ),
    "slots of envelopes repeat after eight": EndFault(
        "every_slot", _loaded(lambda one: replace(one, slot=(one.slot - 1) % 8 + 1))
    ),
    "an onset with keep phase goes on at any frequency": EndFault(
        "onset_of_another_frequency", wrapped(channel_outputs, "shape_to", _keeps_any_frequency)
    ),
    "the phases of one channel have the other sign": EndFault(
        "phases_of_every_channel", _played(_conjugate)
    ),
    "keep phase keeps the phase of the command before": EndFault(
        "phases_of_every_channel", _played(_unturned)
    ),
}
"""Faults by what is wrong."""

__all__ = ["END_FAULTS", "EndFault"]

"""A backend over a backend: motion above, the voltage of the amplifier below.

Everything above it, guard and records included, means motion; conversion is the last step before
the codec, and replies are converted back. See docs/decisions/0044-level-of-what.md.
"""

from collections import OrderedDict
from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import cast, final

from drivers.backend import Backend
from drivers.command import CommandSet, DriveCommand, Knot
from drivers.errors import CommandError, CommandRefused
from drivers.guard import (
    SafeCommandSet,
    SafeEnvelope,
    require_safe,
    safe_voltage_envelope,
    safe_voltages,
)
from drivers.guard.rounding import rounded_down
from drivers.protocol.definition import PROTOCOL
from drivers.protocol.messages import (
    Achieved,
    AmplifierEvent,
    Apply,
    Broadcast,
    Capabilities,
    ChannelLimits,
    Feature,
    GetCaps,
    Loaded,
    LoadEnvelope,
    Nak,
    NakCode,
    Reply,
    Request,
    Stage,
    Status,
)
from drivers.protocol.wire_times import WireTimes
from drivers.statistics import WireCounters
from drivers.voltage.conversion import (
    capabilities_in_motion,
    knot_in_voltage,
    motion_level,
    to_motion,
    to_voltage,
)
from registry.voltage import VoltageDrive

_SETS_KEPT = 8  # more than are ever staged, playing or repeated at once
_SLACK = 1e-6  # of a step; sums of floats
_LEVEL = PROTOCOL.quantities.level


@final
class VoltageBackend(Backend):
    """An amplifier of voltage as one of motion; drives: by channel, of those that are wired."""

    def __init__(self, backend: Backend, drives: Mapping[int, VoltageDrive]) -> None:
        self._backend = backend
        self._drives = dict(drives)
        self._limits: tuple[ChannelLimits, ...] = ()
        # By token: the set of motion and that of voltage.
        self._sent: OrderedDict[int, tuple[SafeCommandSet, SafeCommandSet]] = OrderedDict()
        # By channel: motion and voltage of the last tone that is known to have played.
        self._played: dict[int, tuple[DriveCommand, DriveCommand]] = {}
        # By slot: envelopes of motion, and those of voltage that the amplifier has.
        self._envelopes: dict[int, SafeEnvelope] = {}
        self._loaded: dict[int, tuple[float, tuple[Knot, ...]]] = {}

    async def open(self) -> None:
        """Open the wire."""
        self._sent.clear()
        self._played.clear()
        self._loaded.clear()
        await self._backend.open()

    async def close(self) -> None:
        """Close the wire."""
        await self._backend.close()

    async def exchange(self, request: Request, *, timeout: float) -> Reply:
        """Exchange a request in voltage, and return its reply in motion."""
        require_safe(request)
        if isinstance(request, LoadEnvelope):
            return self._keep(cast("SafeEnvelope", request.envelope))
        if isinstance(request, Stage | Apply):
            requested = cast("SafeCommandSet", request.command_set)
            refusal = await self._load(requested, timeout=timeout)
            if refusal is not None:
                return refusal
            request = replace(request, command_set=self._converted(requested))
        reply = await self._backend.exchange(request, timeout=timeout)
        if isinstance(reply, Nak) and reply.code == NakCode.NO_ENVELOPE:
            self._loaded.clear()
        match reply:
            case Capabilities() if isinstance(request, GetCaps):
                return self._capabilities(reply)
            case Achieved():
                if not isinstance(request, Stage):
                    self._note_played(reply.token)
                return self._achieved(reply)
            case Status():
                self._note_played(reply.token)
                return replace(reply, levels=self._levels(reply))
            case _:
                return reply

    @property
    def last_sent_at(self) -> float:
        """Time [s] when the last byte of the last request went out."""
        return self._backend.last_sent_at

    @property
    def counters(self) -> WireCounters:
        """Frame counters of the wire."""
        return self._backend.counters

    def listen(
        self, on_event: Callable[[AmplifierEvent], None], on_loss: Callable[[str], None]
    ) -> None:
        """Register callbacks."""
        self._backend.listen(on_event, on_loss)

    @property
    def bus(self) -> str | None:
        """Identifier of what one broadcast reaches."""
        return self._backend.bus

    async def broadcast(self, request: Broadcast) -> None:
        """Broadcast; no broadcast has levels."""
        await self._backend.broadcast(request)

    @property
    def carries_sessions(self) -> bool:
        """Whether requests carry their session."""
        return self._backend.carries_sessions

    @property
    def wire_times(self) -> WireTimes:
        """Durations on its wire."""
        return self._backend.wire_times

    def _capabilities(self, reported: Capabilities) -> Capabilities:
        if Feature.VOLTAGE not in reported.features:
            raise CommandError(
                "levels of the amplifier must be of a voltage, since the rig's ERAs have a "
                "`voltage` section, got one that compensates its actuators itself; remove the "
                "sections, or use another amplifier"
            )
        self._limits = tuple(
            replace(limits, level_max=self._highest(channel, limits.level_max))
            for channel, limits in enumerate(reported.limits_of_channels)
        )
        return capabilities_in_motion(reported, self._drives)

    def _highest(self, channel: int, reported: float) -> float:
        """Return the highest amplitude of a channel's voltage, in whole steps of the wire."""
        drive = self._drives.get(channel)
        highest = 0.0 if drive is None else min(reported, drive.swing)
        return rounded_down(highest + _SLACK * _LEVEL.step, _LEVEL)

    def _keep(self, envelope: SafeEnvelope) -> Reply:
        """Keep an envelope until a set says at which frequency it is played."""
        self._envelopes[envelope.slot] = envelope
        return Loaded(envelope.slot, len(envelope.knots))

    async def _load(self, requested: CommandSet, *, timeout: float) -> Nak | None:
        """Load the envelopes of a set at its frequencies; returns a refusal of the amplifier."""
        for command in requested.commands:
            drive = self._drives.get(command.channel)
            for slot in (command.onset, command.ending):
                kept = self._envelopes.get(slot)
                if drive is None or kept is None:
                    continue
                knots = [knot_in_voltage(knot, drive, command.frequency) for knot in kept.knots]
                limits = self._limits[command.channel]
                safe = safe_voltage_envelope(kept, knots, limits)
                content = (safe.step, safe.knots)
                if self._loaded.get(slot) == content:
                    continue
                self._loaded.pop(slot, None)
                reply = await self._backend.exchange(LoadEnvelope(safe), timeout=timeout)
                if isinstance(reply, Nak):
                    return reply
                self._loaded[slot] = content
        return None

    def _converted(self, safe: SafeCommandSet) -> SafeCommandSet:
        """Return a set in voltage; the same again for one that is repeated."""
        known, converted = self._sent.get(safe.token, (None, None))
        if converted is not None and known is safe:
            return converted
        commands = [self._in_voltage(command) for command in safe.commands]
        converted = safe_voltages(safe, commands, self._limits)
        self._sent[safe.token] = safe, converted
        while len(self._sent) > _SETS_KEPT:
            self._sent.popitem(last=False)
        return converted

    def _in_voltage(self, command: DriveCommand) -> DriveCommand:
        drive = self._drives.get(command.channel)
        if drive is None:
            if command.level > 0:
                raise CommandRefused(
                    f"channel {command.channel} must have an ERA with a `voltage` section in the "
                    "rig file, got none",
                    channel=command.channel,
                )
            return command
        _, before = self._played.get(command.channel, (None, None))
        return to_voltage(command, drive, before)

    def _note_played(self, token: int) -> None:
        """Note the tones of a set that plays, if it was sent."""
        if token in self._sent:
            for motion, voltage in zip(*(one.commands for one in self._sent[token]), strict=True):
                if motion.level > 0:
                    self._played[motion.channel] = motion, voltage

    def _achieved(self, reply: Achieved) -> Achieved:
        """Return an achieved set of motion, by the responses that were used for its request."""
        requested, _ = self._sent.get(reply.token, (None, None))
        commands = () if requested is None else requested.commands
        frequencies = {one.channel: one.frequency for one in commands}
        return replace(
            reply,
            commands=tuple(
                to_motion(one, self._drives[one.channel], frequencies.get(one.channel))
                if one.channel in self._drives
                else one
                for one in reply.commands
            ),
        )

    def _levels(self, status: Status) -> tuple[float, ...]:
        """Return levels of motion, at the frequencies that played last.

        A channel whose frequency is unknown keeps its voltage: zero is zero.
        """
        return tuple(
            motion_level(level, self._drives[channel], self._played[channel][0].frequency)
            if channel in self._played
            else level
            for channel, level in enumerate(status.levels)
        )

"""Small tones on the ERAs of a rig, on the path of every pattern.

Routed by the wiring, checked by the guard, over the wire, with the levels that amplifiers confirm.
"""

import math
from collections.abc import Mapping

from controller.group.amplifier_group import AmplifierGroup
from controller.group.guards import make_guards
from controller.loop.routing import commands_by_era, route
from drivers.amplifier import Amplifier
from drivers.command import DriveCommand
from drivers.errors import CommandRefused
from drivers.guard import Guard, SafeCommandSet
from drivers.protocol.definition import PROTOCOL, token_after
from model.rig.rig import Rig
from model.vibration.excitation import Excitation

RAMP = 0.05  # s; long enough not to excite the plate at onset or end
_FADED = 0.01  # s; more than commits and replies are late
_LEVEL_TOLERANCE = 0.02  # relative; more than any amplifier rounds


class TonePlayer:
    """Plays tones on amplifiers by their names in the rig, not yet open.

    ramp [s]: of what was played last.
    """

    def __init__(self, rig: Rig, amplifiers: Mapping[str, Amplifier]) -> None:
        self.ramp = RAMP
        self.token = 0
        self._rig = rig
        self._amplifiers = amplifiers
        self._group = AmplifierGroup(amplifiers)
        self._guards: dict[str, Guard] = {}

    @property
    def guards(self) -> Mapping[str, Guard]:
        """The guard of each amplifier, by name; known once open."""
        return self._guards

    @property
    def pause(self) -> float:
        """Silence [s] between two sets of tones for amplifiers that cannot cross-fade, or 0."""
        fades = all(each.capabilities.has_cross_fades for each in self._amplifiers.values())
        return 0.0 if fades else self.ramp + _FADED

    async def open(self) -> None:
        """Open all amplifiers, disarmed. Raises DriverError, InputError."""
        await self._group.open()
        self._guards = make_guards(self._rig, self._amplifiers)

    async def arm(self) -> None:
        """Switch the high voltage on at level zero."""
        await self._group.arm()

    async def disarm(self) -> None:
        """Ramp to silence, then switch the high voltage off."""
        await self._group.disarm()

    async def play(self, excitation: Excitation) -> Mapping[str, DriveCommand]:
        """Play on all amplifiers; what each driven ERA plays, by name, as its amplifier confirms.

        Raises CommandRefused for a level that is not played.
        """
        self.token = token_after(self.token)
        ramp = min([RAMP, *(guard.ramp_max for guard in self._guards.values())])
        routed = route(excitation, self._rig, token=self.token, ramp=ramp)
        self.ramp = max(commands.ramp for commands in routed.values())
        safe = {name: self._guards[name].check(commands) for name, commands in routed.items()}
        played = await self._group.play(safe)
        if played is None:
            raise CommandRefused(
                "a set of tones was given up, since an amplifier does not reply or was stopped; "
                "start again"
            )
        requested, plays = (commands_by_era(sets, self._rig) for sets in (routed, played.achieved))
        for era, command in requested.items():
            level = plays[era].level if era in plays else 0.0
            step = PROTOCOL.quantities.level.step
            if not math.isclose(command.level, level, rel_tol=_LEVEL_TOLERANCE, abs_tol=step):
                amplifier = self._rig.wiring[era].amplifier
                raise CommandRefused(
                    f"amplifier {amplifier}: level of channel {command.channel} must be "
                    f"{command.level:g}, got {level:g}; let it cool down, or choose another --level"
                )
        return plays

    async def heartbeat(self) -> None:
        """Feed the watchdogs."""
        await self._group.heartbeat()

    async def close(self) -> None:
        """Play silence, confirm it, disarm and close, whatever came before."""
        await self._group.close(self._silence())

    def _silence(self) -> dict[str, SafeCommandSet]:
        """Silent sets for every amplifier that has a guard."""
        channels: dict[str, list[int]] = {name: [] for name in self._guards}
        for wired in self._rig.wiring.values():
            channels.get(wired.amplifier, []).append(wired.number)
        token = token_after(self.token)
        return {
            name: guard.silence(token, channels[name], ramp=RAMP)
            for name, guard in self._guards.items()
        }

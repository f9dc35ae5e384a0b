"""Small tones on the ERAs of a rig, on the path of every pattern.

Routed by the wiring, admitted by the ledgers, over the wire, with the levels that amplifiers
confirm.
"""

import math
from collections.abc import Callable, Mapping

from controller.play.capabilities import PlaybackCapabilities, playback_capabilities
from controller.play.routing import Drive, route, tones_by_era
from drivers.errors import CommandRefused
from drivers.host.amplifier import Amplifier
from drivers.host.group import Group
from drivers.opening import Lines
from drivers.protocol.definition import QUANTITIES
from model.rig.rig import Rig
from model.vibration import Excitation

RAMP = 0.05  # s; long enough not to excite the plate at onset or end
_LEVEL_TOLERANCE = 0.02  # relative; more than any amplifier rounds
_LEVEL_STEP = QUANTITIES["level"].from_wire(1)


class TonePlayer:
    """Plays tones on the amplifiers of a rig; lines: to them, urls: by their names.

    group: of all amplifiers; ramp [s]: of what was played last; token: of its set.
    """

    def __init__(self, rig: Rig, lines: Callable[[], Lines], urls: Mapping[str, str]) -> None:
        self.ramp = RAMP
        self.token = 0
        self.amplifiers: Mapping[str, Amplifier] = {}
        self._rig = rig
        self._lines = lines()
        self._urls = urls
        self.group = Group({})
        self._ramp_max = RAMP

    async def open(self) -> PlaybackCapabilities:
        """Open all amplifiers, disarmed; what they can play. Raises DriverError, InputError."""
        self.amplifiers = {
            name: await self._lines.amplifier(
                url, self._rig.limits, name=name, is_output=name in self._rig.outputs
            )
            for name, url in self._urls.items()
        }
        self.group = Group(self.amplifiers)
        await self.group.open()
        found = playback_capabilities(self._rig, self.amplifiers)
        self._ramp_max = min(RAMP, found.ramp_max)
        return found

    async def silence(self) -> None:
        """Let what plays fall silent."""
        self.ramp = RAMP
        await self.group.silence(RAMP)

    async def play(self, excitation: Excitation) -> Drive:
        """Play on all amplifiers; what each driven ERA plays, by name, as its amplifier confirms.

        Raises CommandRefused for a level that is not played.
        """
        layers = route(excitation, self._rig, ramp=self._ramp_max)
        self.ramp = max(layer.ramp for layer in layers.values())
        played = await self.group.apply({name: [layer] for name, layer in layers.items()})
        self.token = played.token
        plays = tones_by_era(played.layers, self._rig)
        for era, wired in self._rig.wiring.items():
            tones = layers[wired.amplifier].tones
            (requested,) = [tone.level for tone in tones if tone.channel == wired.number]
            level = plays[era].level if era in plays else 0.0
            if not math.isclose(requested, level, rel_tol=_LEVEL_TOLERANCE, abs_tol=_LEVEL_STEP):
                raise CommandRefused(
                    f"amplifier {wired.amplifier}: level of channel {wired.number} must be "
                    f"{requested:g}, got {level:g}; let it cool down, or choose another --level"
                )
        return plays

    async def close(self) -> None:
        """Play silence, confirm it, disarm and close, whatever came before."""
        try:
            await self.group.close(RAMP)
        finally:
            await self._lines.close()

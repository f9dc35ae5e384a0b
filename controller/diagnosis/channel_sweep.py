"""A sweep over the channels of a rig: small tones on each in turn, measured by sensors.

Tones take the path of every pattern: routed by the wiring, checked by the guard, over the wire.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from itertools import pairwise

import numpy as np

from controller.diagnosis.sensors import Sensors
from controller.group.amplifier_group import AmplifierGroup
from controller.group.guards import make_guards
from controller.loop.routing import route
from drivers.amplifier import Amplifier
from drivers.errors import CommandRefused
from drivers.guard import Guard, SafeCommandSet
from drivers.protocol.definition import token_after
from model.arrays import ComplexArray, FloatArray
from model.diagnosis.observation import Observation, Pair
from model.rig.rig import Rig
from model.vibration.excitation import Excitation, Tone

RAMP = 0.05  # s; long enough not to excite the plate at onset or end
_PAIR_FREQUENCIES = 3  # at which channels are driven in pairs
_FADED = 0.01  # s; more than commits and replies are late
_LEVEL_TOLERANCE = 0.02  # relative; more than any amplifier rounds


class ChannelSweep:
    """A sweep over the channels of a rig; its amplifiers are open and armed within `run`.

    level: of every tone, 0..1 of full stroke; settle, listen [s]: before and while sensors are
    read; on_step: called with a description of every tone.
    """

    def __init__(
        self,
        rig: Rig,
        amplifiers: Mapping[str, Amplifier],
        sensors: Sensors,
        *,
        level: float,
        settle: float,
        listen: float,
        on_step: Callable[[str], None] = lambda _: None,
    ) -> None:
        self._rig = rig
        self._amplifiers = amplifiers
        self._group = AmplifierGroup(amplifiers, is_time_stepped=sensors.is_virtual)
        self._sensors = sensors
        self._level, self._settle, self._listen = level, settle, listen
        self._on_step = on_step
        self._guards: dict[str, Guard] = {}
        self._token = 0
        self._ramp = RAMP

    async def run(self, frequencies: Sequence[float]) -> Observation:
        """Measure at frequencies [Hz]; always ends silent and disarmed.

        Raises DriverError.
        """
        rig = self._rig
        shape = (len(frequencies), len(rig.eras), len(self._sensors.names))
        values = np.full(shape, np.nan, dtype=complex)
        pairs = []
        await self._group.open()
        try:
            self._guards = make_guards(rig, self._amplifiers)
            await self._group.arm()
            floor = await self._floor(frequencies)
            for number, era in enumerate(rig.eras):
                for row, frequency in enumerate(frequencies):
                    self._on_step(f"ERA {era.name}, {frequency:g} Hz")
                    values[row, number] = await self._respond([number], frequency)
            for first, second in self._neighbour_pairs():
                for frequency in _evenly_chosen(frequencies, _PAIR_FREQUENCIES):
                    names = f"{rig.eras[first].name} and {rig.eras[second].name}"
                    self._on_step(f"ERAs {names}, {frequency:g} Hz")
                    found = await self._respond([first, second], frequency)
                    pairs.append(Pair(frequency, (first, second), found))
            await self._play({})
            await self._wait(self._ramp)
        finally:
            await self._group.close(self._silence())
        return Observation(
            self._sensors.names,
            self._sensors.points,
            np.array(frequencies, dtype=float),
            values,
            has_phases=False,
            pairs=pairs,
            floor=floor,
        )

    def _neighbour_pairs(self) -> list[tuple[int, int]]:
        """Return pairs of channels of one amplifier in a ring, robust against one dead channel."""
        pairs: list[tuple[int, int]] = []
        for amplifier in self._rig.amplifiers:
            own = [
                number
                for number, era in enumerate(self._rig.eras)
                if self._rig.wiring[era.name].amplifier == amplifier
            ]
            pairs += pairwise(own)
            if len(own) > 2:
                pairs.append((own[0], own[-1]))
        return pairs

    async def _floor(self, frequencies: Sequence[float]) -> FloatArray:
        """Measure the noise floor in units of a response [1/s²] (s,)."""
        self._on_step("silence")
        await self._wait(self._listen)
        now = await self._sensors.time()
        heard = [
            np.abs(await self._sensors.tone(f, since=now - self._listen, until=now))
            for f in _evenly_chosen(frequencies, _PAIR_FREQUENCIES)
        ]
        stroke = min(era.stroke for era in self._rig.eras)
        return np.asarray(np.sqrt(np.mean(np.square(heard), axis=0)) / (self._level * stroke))

    async def _respond(self, numbers: Sequence[int], frequency: float) -> ComplexArray:
        """Measure acceleration per commanded displacement (s,) [1/s²] in the steady state."""
        eras = [self._rig.eras[number] for number in numbers]
        stroke = min(era.stroke for era in eras)
        excitation = {era.name: Tone(frequency, self._level * stroke) for era in eras}
        if not all(each.capabilities.has_cross_fades for each in self._amplifiers.values()):
            await self._play({})  # out, then in
            await self._wait(self._ramp + _FADED)
        frequency = await self._play(excitation) or frequency
        await self._wait(self._ramp + self._settle + self._listen)
        now = await self._sensors.time()
        heard = await self._sensors.tone(frequency, since=now - self._listen, until=now)
        return np.asarray(heard / (self._level * stroke))

    async def _play(self, excitation: Excitation) -> float | None:
        """Play on all amplifiers; return the achieved frequency [Hz], None for silence."""
        self._token = token_after(self._token)
        ramp = min([RAMP, *(guard.ramp_max for guard in self._guards.values())])
        routed = route(excitation, self._rig, token=self._token, ramp=ramp)
        self._ramp = max(commands.ramp for commands in routed.values())
        safe = {name: self._guards[name].check(commands) for name, commands in routed.items()}
        played = await self._group.play(safe)
        assert played is not None  # noqa: S101  nothing else silences them
        frequency = None
        for name, commands in routed.items():
            plays = {command.channel: command for command in played.achieved[name].commands}
            for requested in commands.commands:
                if not requested.level:
                    continue
                found = plays.get(requested.channel)
                level = 0.0 if found is None else found.level
                if found is None or not math.isclose(
                    requested.level, level, rel_tol=_LEVEL_TOLERANCE
                ):
                    raise CommandRefused(
                        f"amplifier {name}: level of channel {requested.channel} must be "
                        f"{requested.level:g}, got {level:g}; let it cool down, or choose another "
                        "--level"
                    )
                frequency = found.frequency
        return frequency

    def _silence(self) -> dict[str, SafeCommandSet]:
        """Return silent sets for every amplifier that has a guard."""
        channels: dict[str, list[int]] = {name: [] for name in self._guards}
        for wired in self._rig.wiring.values():
            channels.get(wired.amplifier, []).append(wired.number)
        token = token_after(self._token)
        return {
            name: guard.silence(token, channels[name], ramp=RAMP)
            for name, guard in self._guards.items()
        }

    async def _wait(self, seconds: float) -> None:
        """Wait, feeding the watchdogs of the amplifiers."""
        while seconds > 0:
            step = min(self._sensors.max_wait, seconds)
            await self._sensors.wait(step)
            await self._group.heartbeat()
            seconds -= step


def _evenly_chosen(frequencies: Sequence[float], count: int) -> list[float]:
    """Return some of the frequencies, evenly over the range."""
    at = np.linspace(0, len(frequencies) - 1, min(count, len(frequencies)) + 2)[1:-1]
    return [frequencies[round(float(index))] for index in at]

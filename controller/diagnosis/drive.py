"""Each channel of a rig in turn, a small tone at a time, and what sensors say meanwhile.

All goes the way of every pattern: routed by the rig's wiring, through the guard, over the wire.
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

RAMP = 0.05  # s; neither begin nor end of a tone strikes the plate
_PAIRED = 3  # frequencies at which channels are driven in pairs
_CHANGED = 0.02  # of a level: more than any amplifier rounds


class Drive:
    """The amplifiers of a rig, open and armed within `run`.

    level: of every tone, 0..1 of full stroke; settle, listen [s]: before and while sensors are
    read; on_step is told of every tone.
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
        self._group = AmplifierGroup(amplifiers)
        self._sensors = sensors
        self._level, self._settle, self._listen = level, settle, listen
        self._on_step = on_step
        self._guards: dict[str, Guard] = {}
        self._token = 0
        self._ramp = RAMP

    async def run(self, frequencies: Sequence[float]) -> Observation:
        """Measure at frequencies [Hz]; ends silent and disarmed, whatever happens.

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
            for first, second in self._neighbours():
                for frequency in _spread(frequencies, _PAIRED):
                    names = f"{rig.eras[first].name} and {rig.eras[second].name}"
                    self._on_step(f"ERAs {names}, {frequency:g} Hz")
                    found = await self._respond([first, second], frequency)
                    pairs.append(Pair(frequency, (first, second), found))
            await self._play({})
            await self._pass(self._ramp)
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

    def _neighbours(self) -> list[tuple[int, int]]:
        """Pairs of channels on one amplifier, all round: one dead channel does not part them."""
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
        """What sensors read in silence, as a response would be [1/s²] (s,)."""
        self._on_step("silence")
        await self._pass(self._listen)
        now = await self._sensors.time()
        heard = [
            np.abs(await self._sensors.tone(f, since=now - self._listen, until=now))
            for f in _spread(frequencies, _PAIRED)
        ]
        stroke = min(era.stroke for era in self._rig.eras)
        return np.asarray(np.sqrt(np.mean(np.square(heard), axis=0)) / (self._level * stroke))

    async def _respond(self, numbers: Sequence[int], frequency: float) -> ComplexArray:
        """Acceleration per displacement asked for (s,) [1/s²], once the plate has settled."""
        eras = [self._rig.eras[number] for number in numbers]
        stroke = min(era.stroke for era in eras)
        wanted = {era.name: Tone(frequency, self._level * stroke) for era in eras}
        frequency = await self._play(wanted) or frequency
        await self._pass(self._ramp + self._settle + self._listen)
        now = await self._sensors.time()
        heard = await self._sensors.tone(frequency, since=now - self._listen, until=now)
        return np.asarray(heard / (self._level * stroke))

    async def _play(self, excitation: Excitation) -> float | None:
        """Play it on all amplifiers; the frequency [Hz] that they really play, None for silence."""
        self._token = token_after(self._token)
        wanted = route(excitation, self._rig, token=self._token, ramp=RAMP)
        self._ramp = max(commands.ramp for commands in wanted.values())
        safe = {name: self._guards[name].check(commands) for name, commands in wanted.items()}
        played = await self._group.play(safe)
        assert played is not None  # noqa: S101  nothing else silences them
        frequency = None
        for name, commands in wanted.items():
            plays = {command.channel: command for command in played.achieved[name].commands}
            for asked in commands.commands:
                if not asked.level:
                    continue
                found = plays.get(asked.channel)
                level = 0.0 if found is None else found.level
                if found is None or not math.isclose(asked.level, level, rel_tol=_CHANGED):
                    raise CommandRefused(
                        f"amplifier {name} plays level {level:g} on channel {asked.channel} in "
                        f"place of {asked.level:g}: let it cool down, or choose a level that it "
                        "plays with --level, then check again"
                    )
                frequency = found.frequency
        return frequency

    def _silence(self) -> dict[str, SafeCommandSet]:
        """Silence for every amplifier that has a guard yet."""
        channels: dict[str, list[int]] = {name: [] for name in self._guards}
        for wired in self._rig.wiring.values():
            channels.get(wired.amplifier, []).append(wired.number)
        token = token_after(self._token)
        return {
            name: guard.silence(token, channels[name], ramp=RAMP)
            for name, guard in self._guards.items()
        }

    async def _pass(self, seconds: float) -> None:
        """Let time pass, and keep the amplifiers' watchdogs fed."""
        while seconds > 0:
            step = min(self._sensors.beat, seconds)
            await self._sensors.wait(step)
            await self._group.heartbeat()
            seconds -= step


def _spread(frequencies: Sequence[float], count: int) -> list[float]:
    """Some of the frequencies, from all over the range."""
    at = np.linspace(0, len(frequencies) - 1, min(count, len(frequencies)) + 2)[1:-1]
    return [frequencies[round(float(index))] for index in at]

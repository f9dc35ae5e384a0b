"""A sweep over the channels of a rig: small tones on each in turn, measured by sensors.

Tones take the path of every pattern: routed by the wiring, checked by the guard, over the wire.
"""

from collections.abc import Callable, Mapping, Sequence
from itertools import pairwise

import numpy as np

from controller.diagnosis.sensors import Sensors
from controller.diagnosis.tone_player import TonePlayer
from drivers.amplifier import Amplifier
from model.arrays import ComplexArray, FloatArray
from model.diagnosis.observation import Observation, Pair
from model.rig.rig import Rig
from model.vibration.excitation import Tone

_PAIR_FREQUENCIES = 3  # at which channels are driven in pairs


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
        self._player = TonePlayer(rig, amplifiers, is_time_stepped=sensors.is_virtual)
        self._sensors = sensors
        self._level, self._settle, self._listen = level, settle, listen
        self._on_step = on_step

    async def run(self, frequencies: Sequence[float]) -> Observation:
        """Measure at frequencies [Hz]; always ends silent and disarmed.

        Raises DriverError.
        """
        rig = self._rig
        shape = (len(frequencies), len(rig.eras), len(self._sensors.names))
        values = np.full(shape, np.nan, dtype=complex)
        pairs = []
        try:
            await self._player.open()
            await self._player.arm()
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
            await self._player.play({})
            await self._wait(self._player.ramp)
        finally:
            await self._player.close()
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
        if self._player.pause:
            await self._player.play({})  # out, then in
            await self._wait(self._player.pause)
        plays = await self._player.play(
            {era.name: Tone(frequency, self._level * stroke) for era in eras}
        )
        frequency = plays[eras[-1].name].frequency
        await self._wait(self._player.ramp + self._settle + self._listen)
        now = await self._sensors.time()
        heard = await self._sensors.tone(frequency, since=now - self._listen, until=now)
        return np.asarray(heard / (self._level * stroke))

    async def _wait(self, seconds: float) -> None:
        """Wait, feeding the watchdogs of the amplifiers."""
        while seconds > 0:
            step = min(self._sensors.max_wait, seconds)
            await self._sensors.wait(step)
            await self._player.heartbeat()
            seconds -= step


def _evenly_chosen(frequencies: Sequence[float], count: int) -> list[float]:
    """Return some of the frequencies, evenly over the range."""
    at = np.linspace(0, len(frequencies) - 1, min(count, len(frequencies)) + 2)[1:-1]
    return [frequencies[round(float(index))] for index in at]

"""Amplifier of protocol 4 in front of a device that plays one sine per channel.

The project's simulated amplifier handles states, sets, watchdog and channel outputs; this program
sends the outputs to a `Device`, in steps of 5 ms. A second process monitors this one, and silences
the device if it stalls or ends. `scpi.py` is the device for signal generators.

Not possible on such a device: the sum of several layers on a channel (the loudest one is played),
changes without steps, and phase relations between a continuing tone and a new one.
"""

import asyncio
import cmath
import contextlib
import math
import os
import select
from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

from drivers.playing import Voice
from drivers.protocol.definition import CLOCK_UNKNOWN, FEATURES, QUANTITIES, STATUS, STATUS_FLAGS
from drivers.protocol.records import Refusal, Values
from sim.amplifier.simulated_amplifier import SimulatedAmplifier
from sim.far_ends.serial_amplifiers import SerialAmplifiers
from sim.transport.far_end import make_terminal

STEP = 0.005  # s; between changes of a tone that fades
BEAT = 0.05  # s; between signs of life for the process that watches
STALLED = 0.25  # s without one, after which it silences the device
REPLY = 0.1  # s; within which the device must have carried out a request
RETRY = 0.05  # s; before it is sent silence again
ALIVE, DONE = b".", b"!"
_LEVEL = QUANTITIES["level"]


@dataclass(frozen=True)
class Tone:
    """A sine: frequency [Hz], amplitude 0..1 of full level, phase [degrees].

    One of the frequency that a channel plays already goes on.
    """

    frequency: float
    amplitude: float
    phase: float


class Device(Protocol):
    """Output device; its methods raise OSError or ValueError if a request fails."""

    channels: int

    def play(self, channel: int, tone: Tone | None) -> None:
        """Note the tone of a channel, None for silence."""

    async def send(self) -> None:
        """Apply all pending settings simultaneously, and wait for confirmation."""

    async def silence(self) -> None:
        """Reconnect if necessary, and switch all outputs off, confirmed."""


class AdaptedAmplifier(SimulatedAmplifier):
    """Amplifier whose levels become 0 only after those of its device; is_lost: it fails."""

    def __init__(self, name: str, *, channels: int) -> None:
        super().__init__(name, channels=channels, is_output=True)
        self.identity = {**self.identity, "product": "adapter", "serial_number": name}
        features = (FEATURES[name] for name in ("output", "events", "mark"))
        self.capabilities["features"] = sum(1 << bit for bit in features)
        self.capabilities["clock_error"] = CLOCK_UNKNOWN  # no generator follows the clock
        self.device_levels = [1.0] * channels
        self.is_lost = True

    def handle(self, name: str, values: Values, now: float) -> Values:
        """Reply to a request; armed only while the device is known to be well."""
        if name in ("GetMeasured", "SetAddress"):
            raise Refusal(f"there is no {name}", "UNKNOWN_TYPE")
        if name == "Arm" and self.is_lost:
            raise Refusal("the device must reply first", "WRONG_STATE")
        return super().handle(name, values, now)

    def status(self, now: float) -> Values:
        """Return the status with levels that the device can still play, without unmeasured
        values."""
        not_measured = {each.name: None for each in STATUS.added}
        status = {**super().status(now), **not_measured, "high_voltage": 0, "temperature": 250}
        pairs = zip(status["levels"], self.device_levels, strict=True)
        status["levels"] = [level or _LEVEL.to_wire(played) for level, played in pairs]
        if any(status["levels"]):
            status["flags"] |= 1 << STATUS_FLAGS["high_voltage"]
        return status

    def is_cause_gone(self, now: float) -> bool:
        """Return whether the instrument replies and the cause of the fault is gone."""
        return not self.is_lost and super().is_cause_gone(now)


class Adapter:
    """Takes requests, and leads the device; sign: as `watch` returns it."""

    def __init__(self, name: str, device: Device, sign: Callable[[bytes], None]) -> None:
        self._loop = asyncio.get_running_loop()
        self._device, self._sign = device, sign
        self._changed = asyncio.Event()
        self._was_reached = False  # from the first time on silence is owed
        self._sent: list[Tone | None] = [None] * device.channels
        self.amplifier = AdaptedAmplifier(name, channels=device.channels)
        self._terminal = make_terminal(self._receive)
        self._line = SerialAmplifiers({1: self.amplifier}, self._terminal.write)
        self.port = self._terminal.port

    def _receive(self, data: bytes) -> None:
        self._line.receive(data, self._loop.time())
        self._changed.set()

    async def run(self) -> None:
        """Lead the device until cancelled, then silence it."""
        self._terminal.listen()
        try:
            while True:
                if self._was_reached:
                    self._sign(ALIVE)
                try:
                    await self._follow()
                except (OSError, ValueError) as error:  # a timeout is an OSError
                    self._lose(error)
                    await asyncio.sleep(RETRY)
        finally:
            self._terminal.close()
            if self._was_reached:
                async with asyncio.timeout(REPLY):
                    await self._device.silence()
                self._sign(DONE)

    def _lose(self, error: Exception) -> None:
        """Trip where the device has failed."""
        if not self.amplifier.is_lost:
            print(f"device lost: {error!r}", flush=True)
            self.amplifier.trip("CHANNEL", self._loop.time())
        self.amplifier.is_lost = True

    async def _follow(self) -> None:
        """Send the changes, then wait for the next one."""
        amplifier = self.amplifier
        if amplifier.is_lost:
            async with asyncio.timeout(REPLY):
                await self._device.silence()
            self._was_reached = True
            self._sent = [None] * len(self._sent)
            amplifier.device_levels = [0.0] * len(self._sent)
            amplifier.is_lost = False
        now = self._loop.time()
        amplifier.tick(now)
        requested = [tone_of(voices, now) for voices in amplifier.playback.all_voices]
        for channel, tone in enumerate(requested):
            if tone != self._sent[channel]:
                self._device.play(channel, tone)
                amplitude = 0.0 if tone is None else tone.amplitude
                levels = amplifier.device_levels
                levels[channel] = max(levels[channel], amplitude)  # until it is confirmed
        if requested != self._sent:
            async with asyncio.timeout(REPLY):
                await self._device.send()
            self._sent = requested
            amplifier.device_levels = [0.0 if one is None else one.amplitude for one in requested]
        self._changed.clear()
        is_moving = any(
            voice.transition.end > now
            for voices in amplifier.playback.all_voices
            for voice in voices
        )
        due = min(amplifier.next_event - self._loop.time(), STEP if is_moving else BEAT)
        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout(max(due, 0.0)):  # wait_for may swallow a cancellation
                await self._changed.wait()


def tone_of(voices: tuple[Voice, ...], now: float) -> Tone | None:
    """Return the loudest of a channel's voices at a time [s]; None below half a step."""
    present = [(voice.transition.at(now), voice) for voice in voices]
    amplitude, loudest = max(present, key=lambda each: abs(each[0]), default=(0j, None))
    level = _LEVEL.quantise(min(abs(amplitude), 1.0))
    if loudest is None or not level:
        return None
    phase = math.degrees(cmath.phase(amplitude))
    return Tone(loudest.frequency, level, round(phase, 2))


def watch(silence: Callable[[], None]) -> Callable[[bytes], None]:
    """Start the process that silences the device once this one stalls or ends.

    Call it before an event loop runs. silence: repeated until it raises nothing. Returns what takes
    ALIVE, from the first time on at least every `BEAT`, or DONE: the device is silent, and nothing
    is left to do. It raises OSError where the other process has silenced the device, or is gone.
    """
    read, write = os.pipe()
    if os.fork():
        os.close(read)
        os.set_blocking(write, False)

        def sign(what: bytes) -> None:
            os.write(write, what)

        return sign
    os.close(write)
    os.setsid()  # Ctrl-C is for the other process
    signs = os.read(read, 1)
    if not signs:
        os._exit(0)
    while signs and select.select([read], [], [], STALLED)[0]:
        signs = os.read(read, 1024)
        if signs.endswith(DONE):
            os._exit(0)
    while True:
        try:
            silence()
        except (OSError, ValueError):
            select.select([], [], [], RETRY)
        else:
            os._exit(0)

"""Adapt a device that plays one sine per channel to protocol 4.

The project's simulated amplifier handles states, command sets, watchdog and layers. `Adapter` sends
the resulting tones to a `Device` every 5 ms. A second process monitors this one, and silences the
device if this process stalls or ends. `scpi.py` is a `Device` for signal generators.

Such a device cannot play several layers on one channel (only the loudest is played), change levels
without steps, or keep the phase between a continuing tone and a new one.
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

from drivers.protocol.definition import CLOCK_UNKNOWN, FEATURES, QUANTITIES, STATUS, STATUS_FLAGS
from drivers.protocol.records import Refusal, Values
from drivers.voices import Voice
from sim.amplifier.simulated_amplifier import SimulatedAmplifier
from sim.far_ends.serial_amplifiers import SerialAmplifiers
from sim.transport.pseudo_terminal import make_terminal

STEP = 0.005  # s; update interval of a fading tone
HEARTBEAT = 0.05  # s; longest interval between heartbeats to the watchdog process
STALL_TIMEOUT = 0.25  # s; without a heartbeat the watchdog process silences the device
REPLY_TIMEOUT = 0.1  # s; for the device to confirm a request
RETRY = 0.05  # s; before the next attempt to silence the device
ALIVE = b"."
DONE = b"!"
_LEVEL = QUANTITIES["level"]


@dataclass(frozen=True)
class Tone:
    """A sine: frequency [Hz], amplitude (0 to 1 of full level), phase [degrees].

    A tone at the frequency that the channel already plays continues it.
    """

    frequency: float
    amplitude: float
    phase: float


class Device(Protocol):
    """Output device; its methods raise OSError or ValueError if a request fails."""

    channels: int

    def play(self, channel: int, tone: Tone | None) -> None:
        """Store the tone of a channel; None for silence."""

    async def send(self) -> None:
        """Apply all stored tones simultaneously, and wait for confirmation."""

    async def silence(self) -> None:
        """Reconnect if necessary, switch all outputs off, and wait for confirmation."""


class AdaptedAmplifier(SimulatedAmplifier):
    """Simulated amplifier that reports a level of 0 only after its device has confirmed it.

    device_levels: highest level that the device may still play, by channel; is_lost: the device
    does not reply.
    """

    def __init__(self, name: str, *, channels: int) -> None:
        super().__init__(name, channels=channels, is_output=True)
        self.identity = {**self.identity, "product": "adapter", "serial_number": name}
        features = (FEATURES[name] for name in ("output", "events", "mark"))
        self.capabilities["features"] = sum(1 << bit for bit in features)
        self.capabilities["clock_error"] = CLOCK_UNKNOWN  # no generator follows the clock
        self.device_levels = [1.0] * channels
        self.is_lost = True

    def handle(self, name: str, values: Values, now: float) -> Values:
        """Reply to a request; rejects Arm while the device does not reply."""
        if name in ("GetMeasured", "SetAddress"):
            raise Refusal(f"there is no {name}", "UNKNOWN_TYPE")
        if name == "Arm" and self.is_lost:
            raise Refusal("the device must reply first", "WRONG_STATE")
        return super().handle(name, values, now)

    def status(self, now: float) -> Values:
        """Return the status with the device's levels and without values that it cannot measure."""
        not_measured = {field.name: None for field in STATUS.added}
        status = {**super().status(now), **not_measured, "high_voltage": 0, "temperature": 250}
        pairs = zip(status["levels"], self.device_levels, strict=True)
        status["levels"] = [level or _LEVEL.to_wire(played) for level, played in pairs]
        if any(status["levels"]):
            status["flags"] |= 1 << STATUS_FLAGS["high_voltage"]
        return status

    def is_cause_gone(self, now: float) -> bool:
        """Whether the device replies and the cause of the fault is gone."""
        return not self.is_lost and super().is_cause_gone(now)


class Adapter:
    """Receives requests and controls the device; heartbeat: the function that `watch` returns."""

    def __init__(self, name: str, device: Device, heartbeat: Callable[[bytes], None]) -> None:
        self._loop = asyncio.get_running_loop()
        self._device = device
        self._heartbeat = heartbeat
        self._changed = asyncio.Event()
        self._was_reached = False  # once it has replied, the device must end silent
        self._sent: list[Tone | None] = [None] * device.channels
        self.amplifier = AdaptedAmplifier(name, channels=device.channels)
        self._terminal = make_terminal(self._receive)
        self._line = SerialAmplifiers({1: self.amplifier}, self._terminal.write)
        self.port = self._terminal.port

    def _receive(self, data: bytes) -> None:
        self._line.receive(data, self._loop.time())
        self._changed.set()

    async def run(self) -> None:
        """Control the device until cancelled, then silence it."""
        self._terminal.listen()
        try:
            while True:
                if self._was_reached:
                    self._heartbeat(ALIVE)
                try:
                    await self._update()
                except (OSError, ValueError) as error:  # a timeout is an OSError
                    self._lose(error)
                    await asyncio.sleep(RETRY)
        finally:
            self._terminal.close()
            if self._was_reached:
                async with asyncio.timeout(REPLY_TIMEOUT):
                    await self._device.silence()
                self._heartbeat(DONE)

    def _lose(self, error: Exception) -> None:
        """Trip because the device has failed."""
        if not self.amplifier.is_lost:
            print(f"device lost: {error!r}", flush=True)
            self.amplifier.trip("CHANNEL", self._loop.time())
        self.amplifier.is_lost = True

    async def _update(self) -> None:
        """Send changed tones to the device, then wait until the next update is due."""
        if self.amplifier.is_lost:
            await self._silence_device()
        now = self._loop.time()
        self.amplifier.tick(now)
        all_voices = self.amplifier.playback.all_voices
        await self._send([tone_of(voices, now) for voices in all_voices])
        self._changed.clear()
        is_fading = any(is_any_fading(voices, now) for voices in all_voices)
        interval = STEP if is_fading else HEARTBEAT
        timeout = min(self.amplifier.next_event - self._loop.time(), interval)
        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout(max(timeout, 0.0)):  # wait_for can swallow a cancellation
                await self._changed.wait()

    async def _silence_device(self) -> None:
        async with asyncio.timeout(REPLY_TIMEOUT):
            await self._device.silence()
        self._was_reached = True
        self._sent = [None] * len(self._sent)
        self.amplifier.device_levels = [0.0] * len(self._sent)
        self.amplifier.is_lost = False

    async def _send(self, tones: list[Tone | None]) -> None:
        """Send the tones of all channels, if any has changed."""
        if tones == self._sent:
            return
        levels = self.amplifier.device_levels
        for channel, tone in enumerate(tones):
            if tone != self._sent[channel]:
                self._device.play(channel, tone)
                # Until the change is confirmed, the device may play the higher of both levels.
                levels[channel] = max(levels[channel], amplitude_of(tone))
        async with asyncio.timeout(REPLY_TIMEOUT):
            await self._device.send()
        self._sent = tones
        self.amplifier.device_levels = [amplitude_of(tone) for tone in tones]


def is_any_fading(voices: tuple[Voice, ...], now: float) -> bool:
    """Whether the amplitude of any voice changes at a time [s]."""
    return any(voice.transition.end > now for voice in voices)


def amplitude_of(tone: Tone | None) -> float:
    """Return the amplitude of a tone; 0 for silence."""
    return 0.0 if tone is None else tone.amplitude


def tone_of(voices: tuple[Voice, ...], now: float) -> Tone | None:
    """Return the loudest voice of a channel at a time [s]; None if its level rounds to 0."""
    if not voices:
        return None
    loudest = max(voices, key=lambda voice: abs(voice.transition.at(now)))
    amplitude = loudest.transition.at(now)
    level = _LEVEL.quantise(min(abs(amplitude), 1.0))
    if not level:
        return None
    phase = math.degrees(cmath.phase(amplitude))
    return Tone(loudest.frequency, level, round(phase, 2))


def watch(silence: Callable[[], None]) -> Callable[[bytes], None]:
    """Start the watchdog process, which silences the device if this process stalls or ends.

    Call it before an event loop runs. silence: repeated until it raises nothing. Returns the
    function that sends a heartbeat. Monitoring begins with the first one: send ALIVE at least every
    `HEARTBEAT` seconds, and DONE once the device is silent, which ends the watchdog. The function
    raises OSError if the watchdog has silenced the device or has ended.
    """
    read, write = os.pipe()
    if os.fork():
        os.close(read)
        os.set_blocking(write, False)

        def heartbeat(message: bytes) -> None:
            os.write(write, message)

        return heartbeat
    os.close(write)
    os.setsid()  # Ctrl-C ends the monitored process only
    received = os.read(read, 1)
    if not received:
        os._exit(0)
    while received and select.select([read], [], [], STALL_TIMEOUT)[0]:
        received = os.read(read, 1024)
        if received.endswith(DONE):
            os._exit(0)
    while True:
        try:
            silence()
        except (OSError, ValueError):
            select.select([], [], [], RETRY)
        else:
            os._exit(0)

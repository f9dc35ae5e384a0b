"""An output by PortAudio, through python-sounddevice."""

import os
import resource
from collections.abc import Mapping
from types import ModuleType
from typing import Any

from drivers.errors import LinkError
from model.errors import InputError
from sim import libjack
from sim.soft_amp.engine import Engine
from sim.soft_amp.settings import Settings, check_rate

_CHANNELS, _RATE, _UNAVAILABLE = -9998, -9997, -9985  # errors of portaudio.h
_WITH_PRIORITY, _WITHOUT = 128, 512  # frames of a block


def sounddevice() -> ModuleType:
    """The library; raises InputError where it or PortAudio is missing."""
    try:
        import sounddevice as library
    except ModuleNotFoundError:
        raise InputError(
            "PortAudio: python-sounddevice must be installed: pip install 'era-haptics[sound]'"
        ) from None
    except OSError:
        raise InputError(
            "PortAudio: its library must be installed; Debian: apt install libportaudio2"
        ) from None
    return library  # type: ignore[no-any-return]


def check_free(library: ModuleType, device: Mapping[str, Any], channels: int) -> None:
    """Raise LinkError for a device of PortAudio over JACK that another program plays to.

    Other drivers refuse the second program themselves; JACK adds up what both play.
    """
    if "JACK" in library.query_hostapis(device["hostapi"])["name"]:
        libjack.check_free(device["name"], channels)


def portaudio_devices() -> list[tuple[int, str, int, float]]:
    """Number, name, output channels and rate [Hz] of each device that plays; InputError."""
    library = sounddevice()
    hosts = library.query_hostapis()
    return [
        (
            number,
            f"{device['name']}, {hosts[device['hostapi']]['name']}",
            device["max_output_channels"],
            device["default_samplerate"],
        )
        for number, device in enumerate(library.query_devices())
        if device["max_output_channels"] > 0
    ]


def may_be_realtime() -> bool:
    """Whether this process may raise the priority of its threads."""
    limit, _ = (
        resource.getrlimit(resource.RLIMIT_RTPRIO) if hasattr(resource, "RLIMIT_RTPRIO") else (0, 0)
    )
    return limit != 0 or os.geteuid() == 0


class PortAudioOutput:
    """A stream of interleaved floats; the callback is C, without Python."""

    def __init__(self, settings: Settings) -> None:
        self._library = sounddevice()
        # A device that came since is not seen otherwise.
        self._library._terminate()
        self._library._initialize()
        self._settings = settings
        number: int | str = settings.device
        if settings.device.isdecimal():
            number = int(settings.device)
        try:
            device = self._library.query_devices(number, "output")
        except (ValueError, self._library.PortAudioError) as problem:
            raise InputError(
                f"--device {settings.device}: {str(problem).splitlines()[0]}; list devices with "
                "era soft-amp --list"
            ) from None
        self.name = device["name"]
        self._number = device["index"]
        if device["max_output_channels"] < settings.channels:
            raise InputError(
                f"--channels must be at most {device['max_output_channels']}, those of "
                f"{self.name}, got {settings.channels}"
            )
        check_free(self._library, device, settings.channels)
        self.rate = check_rate(settings.rate or device["default_samplerate"], what=self.name)
        self.block = settings.block or (_WITH_PRIORITY if may_be_realtime() else _WITHOUT)
        try:
            self._library.check_output_settings(
                self._number, settings.channels, "float32", samplerate=self.rate
            )
        except self._library.PortAudioError as problem:
            raise self._refused(problem) from None
        self._stream: Any = None

    def _refused(self, problem: Exception) -> Exception:
        text, number = str(problem.args[0]), problem.args[1] if len(problem.args) > 1 else 0
        if number == _RATE:
            return InputError(f"--rate: {self.name} does not offer {self.rate} Hz; try 48000")
        if number == _CHANNELS:
            return InputError(
                f"--channels: {self.name} does not offer {self._settings.channels} channels"
            )
        if number == _UNAVAILABLE:
            return LinkError(f"--device {self.name}: busy; end the program that plays on it")
        return LinkError(f"--device {self.name}: cannot be opened: {text}")

    def start(self, engine: Engine) -> None:
        """Let PortAudio call the engine; raises LinkError."""
        ffi = self._library._ffi
        callback = ffi.cast("PaStreamCallback *", engine.address("sound_portaudio"))
        try:
            # The one class that takes a callback of C; for authors of libraries, as it says.
            self._stream = self._library._StreamBase(
                kind="output",
                samplerate=self.rate,
                blocksize=self.block,
                device=self._number,
                channels=self._settings.channels,
                dtype="float32",
                latency="low",
                callback=callback,
                clip_off=True,
                dither_off=True,
                userdata=ffi.NULL,
            )
            self._stream.start()
        except self._library.PortAudioError as problem:
            raise self._refused(problem) from None

    def is_playing(self) -> bool:
        """Whether PortAudio still calls for samples."""
        try:
            return bool(self._stream.active)
        except self._library.PortAudioError:
            return False

    def close(self) -> None:
        """Stop at once, and close the device."""
        if self._stream is not None:
            self._stream.close(ignore_errors=True)
            self._stream = None

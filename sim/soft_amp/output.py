"""Sound devices of PortAudio: their selection by name or number, and streams with a C callback."""

import atexit
import os
import resource
from collections.abc import Iterator
from types import ModuleType
from typing import Any, TypeAlias

from drivers.errors import LinkError
from model.errors import InputError
from registry.plugins import did_you_mean
from sim.soft_amp.engine import callback_address
from sim.soft_amp.settings import SoftAmplifierSettings, check_rate

JACK = "JACK"
"""Begin of the name of PortAudio's JACK host API."""

# Frames of a block at real-time and at ordinary priority, below the 10 ms of a reply.
_REALTIME_BLOCK = 128
_ORDINARY_BLOCK = 256


def sounddevice() -> ModuleType:
    """Return python-sounddevice; raises InputError if it or PortAudio is missing."""
    try:
        import sounddevice as library
    except ModuleNotFoundError:
        raise InputError(
            "PortAudio: python-sounddevice must be installed: pip install -e '.[sound]'"
        ) from None
    except OSError:
        raise InputError(
            "PortAudio: its library must be installed; Debian: apt install libportaudio2"
        ) from None
    return library  # type: ignore[no-any-return]


def portaudio_device(device: str, *, outputs: int, inputs: int = 0) -> Any:
    """Find a device by name or number, and return PortAudio's description.

    outputs, inputs: required channels. Raises InputError for an unsuitable device, LinkError if
    there is no device at all.
    """
    library = sounddevice()
    number: int | str = int(device) if device.isdecimal() else device
    try:
        description = library.query_devices(number, None if inputs else "output")
    except (ValueError, library.PortAudioError) as problem:
        raise _no_device(device, str(problem).splitlines()[0]) from None
    for direction, count in (("output", outputs), ("input", inputs)):
        available = description[f"max_{direction}_channels"]
        if available < count:
            raise InputError(
                f"--device {description['name']} must have {count} {direction}s, got {available}; "
                "list devices with era soft-amp --list"
            )
    return description


def _no_device(device: str, reason: str) -> Exception:
    """The error for a device that PortAudio does not find, or finds more than once."""
    library = sounddevice()
    names = [description["name"] for description in library.query_devices()]
    if not names:
        return LinkError(
            "PortAudio: no device found; connect a sound card, or start the sound server as this "
            "user"
        )
    if device.lower().startswith("jack"):
        remedy = 'a device of JACK is named --device "system, JACK" or "CLIENT, JACK"; '
    else:
        remedy = did_you_mean(device, names)
    return InputError(
        f"--device {device}: {reason.removesuffix(':')}; {remedy}list devices with era soft-amp "
        "--list"
    )


def portaudio_stream(
    number: int, callback: int, user_data: int, *, outputs: int, inputs: int = 0, **options: object
) -> Any:
    """Start a stream of a device by number, with a C callback that gets the address of its data.

    Raises PortAudioError.
    """
    library = sounddevice()
    ffi = library._ffi
    channels: int | tuple[int, int]
    if outputs and inputs:
        kind = "duplex"
        channels = (inputs, outputs)
    elif inputs:
        kind = "input"
        channels = inputs
    else:
        kind = "output"
        channels = outputs
    # Only this class takes a C callback. It is made for authors of libraries.
    stream = library._StreamBase(
        kind=kind,
        device=number,
        channels=channels,
        dtype="float32",
        callback=ffi.cast("PaStreamCallback *", callback),
        clip_off=True,
        dither_off=True,
        userdata=ffi.cast("void *", user_data),
        **options,
    )
    try:
        stream.start()
    except BaseException:
        stream.close(ignore_errors=True)
        raise
    return stream


def is_stream_active(stream: Any) -> bool:
    """Whether PortAudio still calls the callback of a stream."""
    try:
        return bool(stream.active)
    except sounddevice().PortAudioError:
        return False


def forget_lost_device() -> None:
    """Do not end PortAudio at exit: without its JACK server it would abort the process."""
    atexit.unregister(sounddevice()._exit_handler)


def is_of_jack(device: Any) -> bool:
    """Whether a device, as PortAudio describes it, belongs to the JACK host API."""
    name: str = sounddevice().query_hostapis(device["hostapi"])["name"]
    return name.startswith(JACK)


def may_be_realtime() -> bool:
    """Whether this process may raise the priority of its threads."""
    if os.geteuid() == 0:
        return True
    if not hasattr(resource, "RLIMIT_RTPRIO"):
        return False
    limit, _ = resource.getrlimit(resource.RLIMIT_RTPRIO)
    return limit != 0


def default_block(device: Any) -> int:
    """Frames of a block of a device unless stated; 0: the period of the JACK server."""
    if is_of_jack(device):
        return 0
    return _REALTIME_BLOCK if may_be_realtime() else _ORDINARY_BLOCK


_REFUSED = {-9997: "--rate", -9998: "--channels"}
"""The option at fault by paInvalidSampleRate, paInvalidChannelCount of portaudio.h."""


class PortAudioOutput:
    """The stream of a software amplifier, with a callback in C.

    Raises InputError for an unsuitable device, LinkError for a busy or missing device.
    """

    def __init__(self, settings: SoftAmplifierSettings) -> None:
        self._library = sounddevice()
        self._settings = settings
        device = portaudio_device(settings.device, outputs=settings.channels)
        self.name: str = device["name"]
        self.rate = check_rate(settings.rate or device["default_samplerate"], what=self.name)
        """Samples per second [Hz]."""
        self._number: int = device["index"]
        self._block = settings.block or default_block(device)
        try:
            self._library.check_output_settings(
                self._number, settings.channels, "float32", samplerate=self.rate
            )
        except self._library.PortAudioError as problem:
            raise self._refused(problem) from None
        self._stream: Any = None

    def _refused(self, problem: Exception) -> Exception:
        text = problem.args[0]
        number = problem.args[-1]
        if number in _REFUSED:
            return InputError(
                f"{_REFUSED[number]} must be supported by {self.name}, got {self.rate} Hz, "
                f"{self._settings.channels} channels: {text}; omit --rate for its own, or try "
                "48000"
            )
        return LinkError(
            f"--device {self.name}: cannot be opened: {text}; end the program that plays on it"
        )

    def start(self) -> None:
        """Let PortAudio call the engine; raises LinkError."""
        try:
            self._stream = portaudio_stream(
                self._number,
                callback_address("sound_portaudio"),
                0,
                outputs=self._settings.channels,
                samplerate=self.rate,
                blocksize=self._block,
                latency="low",
            )
        except self._library.PortAudioError as problem:
            raise self._refused(problem) from None

    def is_playing(self) -> bool:
        """Whether PortAudio still asks for samples."""
        return is_stream_active(self._stream)

    def abandon(self) -> None:
        """Leave a lost device to the end of the process."""
        self._stream = None
        forget_lost_device()

    def close(self) -> None:
        """Stop immediately, and close the device."""
        if self._stream is not None:
            self._stream.close(ignore_errors=True)
            self._stream = None


Device: TypeAlias = dict[str, Any]
"""A device for programs.

device: what `--device` takes; rate_hz: its default; block_frames: frames of a block unless stated,
None for the period of the JACK server.
"""


def portaudio_devices() -> Iterator[Device]:
    """Yield the devices of PortAudio in the order of their numbers; raises InputError."""
    library = sounddevice()
    hosts = library.query_hostapis()
    for number, device in enumerate(library.query_devices()):
        yield {
            "device": str(number),
            "host": hosts[device["hostapi"]]["name"],
            "name": device["name"],
            "outputs": device["max_output_channels"],
            "inputs": device["max_input_channels"],
            "rate_hz": round(device["default_samplerate"]),
            "block_frames": default_block(device) or None,
        }


_MISSING = {
    "PortAudio": "PortAudio finds no device; connect a sound card",
    JACK: "no JACK server is running for this user; start jackd first if you want to use it",
}


def listed_devices() -> tuple[list[str], dict[str, Any]]:
    """All devices as lines and for programs, and the reasons if devices or JACK are missing."""
    devices = list(portaudio_devices())
    missing = []
    if not devices:
        missing.append({"host": "PortAudio", "reason": _MISSING["PortAudio"]})
    if not any(device["host"].startswith(JACK) for device in devices):
        missing.append({"host": JACK, "reason": _MISSING[JACK]})
    rows = [_line(device) for device in devices]
    rows += [entry["reason"] for entry in missing]
    return rows, {"devices": devices, "missing": missing}


def _line(device: Device) -> str:
    block = device["block_frames"]
    blocks = f"blocks of {block} frames" if block else "blocks of the server's period"
    return (
        f"{device['device']}: {device['name']}, {device['host']}: {device['outputs']} outputs, "
        f"{device['inputs']} inputs, {device['rate_hz']} Hz, {blocks}"
    )

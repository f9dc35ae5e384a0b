"""What a software amplifier plays through: ports of a JACK client, or a device of PortAudio."""

import ctypes
import os
import resource
from collections.abc import Iterator
from contextlib import closing
from types import ModuleType
from typing import Any, TypeAlias

from drivers.errors import LinkError
from model.errors import InputError
from registry.plugins import did_you_mean
from sim.soft_amp.engine import JackCalls, callback_address
from sim.soft_amp.engine import library as engine
from sim.soft_amp.jack import IS_INPUT, JackClient, NoSound, jack_name, libjack
from sim.soft_amp.settings import SoftAmplifierSettings, check_rate

_CLIENT = "era-soft-amp"

_CALLED_BY_ENGINE = {
    "buffer": "jack_port_get_buffer",
    "cycle_times": "jack_get_cycle_times",
    "time": "jack_get_time",
    "latency": "jack_port_get_latency_range",
    "is_realtime": "jack_is_realtime",
    "port_by_id": "jack_port_by_id",
    "is_mine": "jack_port_is_mine",
}


class JackOutput:
    """As many ports as the amplifier has channels, each connected to the next one of a client."""

    def __init__(self, settings: SoftAmplifierSettings, *, destination: str) -> None:
        self._client = JackClient(_CLIENT)
        try:
            self.rate = check_rate(self._client.rate, what="JACK server")
            if settings.rate not in (None, self.rate):
                raise InputError(
                    f"--rate must be {self.rate} Hz, that of the JACK server, got {settings.rate}; "
                    f"start the server with -r {settings.rate}, or omit --rate"
                )
            self.block = self._client.block
            if settings.block not in (None, self.block):
                raise InputError(
                    f"--block must be {self.block} frames, those of the JACK server, got "
                    f"{settings.block}; start the server with -p {settings.block}, or omit --block"
                )
            self.name = jack_name(destination)
            self._client.wire(destination, outputs=settings.channels)
        except BaseException:
            self.close()
            raise

    def start(self) -> None:
        """Connect, and let JACK call the engine; raises LinkError."""
        library = libjack()
        calls = JackCalls(client=self._client.pointer)
        calls.ports[: len(self._client.outputs)] = self._client.outputs
        for field, name in _CALLED_BY_ENGINE.items():
            setattr(calls, field, ctypes.cast(getattr(library, name), ctypes.c_void_p))
        engine().sound_use_jack(ctypes.byref(calls))
        self._client.start(
            {
                "jack_set_process_callback": callback_address("sound_jack_process"),
                "jack_set_xrun_callback": callback_address("sound_jack_xrun"),
                "jack_on_shutdown": callback_address("sound_jack_shutdown"),
                "jack_set_port_connect_callback": callback_address("sound_jack_connect"),
            }
        )

    def is_playing(self) -> bool:
        """Always, since JACK tells of a loss by its callbacks."""
        return True

    def close(self) -> None:
        """Leave the server."""
        self._client.close()


_WITH_PRIORITY, _WITHOUT = 128, 256  # frames of a block, each below the 10 ms of a reply


def sounddevice() -> ModuleType:
    """The library; raises InputError where it or PortAudio is missing."""
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
    """Return what PortAudio says of a device by name or number, which must have these channels.

    Raises InputError, and LinkError for one over JACK that another program plays to: other drivers
    refuse the second program themselves, JACK adds up what both play.
    """
    library = sounddevice()
    number: int | str = int(device) if device.isdecimal() else device
    try:
        found = library.query_devices(number, None if inputs else "output")
    except (ValueError, library.PortAudioError) as problem:
        known = [each["name"] for each in library.query_devices()]
        if not known:
            raise NoSound(
                "PortAudio: it has no device; connect a sound card, or start its sound server"
            ) from None
        raise InputError(
            f"--device {device}: {str(problem).splitlines()[0]}; "
            f"{did_you_mean(device, known)}list devices with era soft-amp --list"
        ) from None
    for what, count in (("output", outputs), ("input", inputs)):
        offered = found[f"max_{what}_channels"]
        if offered < count:
            raise InputError(
                f"--device {found['name']} must have {count} {what}s, got {offered}; list devices "
                "with era soft-amp --list"
            )
    if outputs and "JACK" in library.query_hostapis(found["hostapi"])["name"]:
        with closing(JackClient("era-check")) as client:
            ports = client.ports_of(found["name"], IS_INPUT)[:outputs]
            client.check_free(ports, device=found["name"])
    return found


def portaudio_stream(
    number: int, callback: int, given: int, *, outputs: int, inputs: int = 0, **options: object
) -> Any:
    """Start a stream of a device by number, with a callback of C that is given an address.

    Raises PortAudioError.
    """
    library = sounddevice()
    ffi = library._ffi
    kind = "duplex" if outputs and inputs else "input" if inputs else "output"
    channels = {"duplex": (inputs, outputs), "input": inputs, "output": outputs}[kind]
    # The one class that takes a callback of C; for authors of libraries, as it says.
    stream = library._StreamBase(
        kind=kind,
        device=number,
        channels=channels,
        dtype="float32",
        callback=ffi.cast("PaStreamCallback *", callback),
        clip_off=True,
        dither_off=True,
        userdata=ffi.cast("void *", given),
        **options,
    )
    try:
        stream.start()
    except BaseException:
        stream.close(ignore_errors=True)
        raise
    return stream


def may_be_realtime() -> bool:
    """Whether this process may raise the priority of its threads."""
    limit, _ = (
        resource.getrlimit(resource.RLIMIT_RTPRIO) if hasattr(resource, "RLIMIT_RTPRIO") else (0, 0)
    )
    return limit != 0 or os.geteuid() == 0


def default_block() -> int:
    """Frames of a block of PortAudio, unless stated."""
    return _WITH_PRIORITY if may_be_realtime() else _WITHOUT


_REFUSED = {-9997: "--rate", -9998: "--channels"}
"""The option at fault by paInvalidSampleRate, paInvalidChannelCount of portaudio.h."""


class PortAudioOutput:
    """A stream of interleaved floats; the callback is C, without Python."""

    def __init__(self, settings: SoftAmplifierSettings) -> None:
        self._library = sounddevice()
        # A device that came since is not seen otherwise.
        self._library._terminate()
        try:
            self._library._initialize()
        except self._library.PortAudioError as problem:
            raise NoSound(f"PortAudio: {problem.args[0]}; start its sound server") from None
        self._settings = settings
        device = portaudio_device(settings.device, outputs=settings.channels)
        self.name, self._number = device["name"], device["index"]
        self.rate = check_rate(settings.rate or device["default_samplerate"], what=self.name)
        self.block = settings.block or default_block()
        try:
            self._library.check_output_settings(
                self._number, settings.channels, "float32", samplerate=self.rate
            )
        except self._library.PortAudioError as problem:
            raise self._refused(problem) from None
        self._stream: Any = None

    def _refused(self, problem: Exception) -> Exception:
        text, number = problem.args[0], problem.args[-1]
        if number in _REFUSED:
            return InputError(
                f"{_REFUSED[number]} must be one that {self.name} offers, got {self.rate} Hz, "
                f"{self._settings.channels} channels: {text}; omit --rate for its own, or try 48000"
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
                blocksize=self.block,
                latency="low",
            )
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


Output: TypeAlias = JackOutput | PortAudioOutput
"""An open device with its name, rate [Hz] and block [frames], 0 if it varies; see either."""


def open_output(settings: SoftAmplifierSettings) -> Output:
    """Open the device of an amplifier; InputError, LinkError where it is busy or gone.

    NoSound where there is no sound server or card yet.
    """
    kind, _, name = settings.device.partition(":")
    if kind == "jack":
        return JackOutput(settings, destination=name)
    return PortAudioOutput(settings)


Device: TypeAlias = dict[str, Any]
"""A device for programs; device: what `--device` takes; block_frames: of a block, by default.

rate_hz: that of the server, which has no other, or the default of a device of PortAudio.
"""


def jack_devices() -> Iterator[Device]:
    """The hardware of the JACK server, and its clients; raises InputError, LinkError."""
    with closing(JackClient("era-list")) as client:
        for name, outputs, inputs in client.clients():
            if outputs + inputs:
                yield {
                    "device": jack_name(name),
                    "host": "JACK",
                    "name": name or "hardware",
                    "outputs": outputs,
                    "inputs": inputs,
                    "rate_hz": client.rate,
                    "block_frames": client.block,
                }


def portaudio_devices() -> Iterator[Device]:
    """The devices of PortAudio, by their numbers; raises InputError."""
    library = sounddevice()
    hosts = library.query_hostapis()
    for number, each in enumerate(library.query_devices()):
        yield {
            "device": str(number),
            "host": hosts[each["hostapi"]]["name"],
            "name": each["name"],
            "outputs": each["max_output_channels"],
            "inputs": each["max_input_channels"],
            "rate_hz": round(each["default_samplerate"]),
            "block_frames": default_block(),
        }


def listed_devices() -> tuple[list[str], dict[str, Any]]:
    """All devices as lines and for programs, with what is missing and why."""
    found: list[Device] = []
    missing: list[dict[str, str]] = []
    for host, devices in (("JACK", jack_devices), ("PortAudio", portaudio_devices)):
        try:
            found += devices()
        except (InputError, LinkError) as problem:
            missing.append({"host": host, "reason": str(problem)})
    rows = [*map(_line, found)]
    rows += [f"no {each['host']}: {each['reason']}" for each in missing]
    return rows, {"devices": found, "missing": missing}


def _line(each: Device) -> str:
    name = "" if each["name"] in each["device"] else "{name}, {host}: "
    line = "{device}: " + name + "{outputs} outputs, {inputs} inputs, {rate_hz} Hz, blocks of "
    return (line + "{block_frames} frames").format(**each)

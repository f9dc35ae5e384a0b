"""An output to the ports of a JACK client, by libjack itself."""

import ctypes
import ctypes.util
import re
from collections import Counter
from functools import cache

from drivers.errors import LinkError
from model.errors import InputError
from sim.soft_amp.engine import Engine, JackCalls
from sim.soft_amp.settings import Settings, check_rate

CLIENT = "era-soft-amp"

_AUDIO = b"32 bit float mono audio"
_IS_INPUT, _IS_OUTPUT, _IS_PHYSICAL, _IS_TERMINAL = 1, 2, 4, 16
_NO_START_SERVER = 1
_SERVER_FAILED = 0x10
_LIBRARIES = ("jack", "libjack.so.0")

_Pointer = ctypes.c_void_p
_Text = ctypes.c_char_p
_FUNCTIONS = {  # name: (result, arguments)
    "jack_client_open": (_Pointer, (_Text, ctypes.c_int, _Pointer)),
    "jack_client_close": (ctypes.c_int, (_Pointer,)),
    "jack_activate": (ctypes.c_int, (_Pointer,)),
    "jack_get_sample_rate": (ctypes.c_uint32, (_Pointer,)),
    "jack_get_buffer_size": (ctypes.c_uint32, (_Pointer,)),
    "jack_get_ports": (ctypes.POINTER(_Text), (_Pointer, _Text, _Text, ctypes.c_ulong)),
    "jack_port_by_name": (_Pointer, (_Pointer, _Text)),
    "jack_port_get_all_connections": (ctypes.POINTER(_Text), (_Pointer, _Pointer)),
    "jack_port_name": (_Text, (_Pointer,)),
    "jack_port_register": (
        _Pointer,
        (_Pointer, _Text, _Text, ctypes.c_ulong, ctypes.c_ulong),
    ),
    "jack_connect": (ctypes.c_int, (_Pointer, _Text, _Text)),
    "jack_free": (None, (_Pointer,)),
    "jack_set_process_callback": (ctypes.c_int, (_Pointer, _Pointer, _Pointer)),
    "jack_set_xrun_callback": (ctypes.c_int, (_Pointer, _Pointer, _Pointer)),
    "jack_set_port_connect_callback": (ctypes.c_int, (_Pointer, _Pointer, _Pointer)),
    "jack_on_shutdown": (None, (_Pointer, _Pointer, _Pointer)),
    "jack_set_error_function": (None, (_Pointer,)),
    "jack_set_info_function": (None, (_Pointer,)),
}
_CALLED_BY_ENGINE = {
    "buffer": "jack_port_get_buffer",
    "frame_time": "jack_last_frame_time",
    "is_realtime": "jack_is_realtime",
    "port_by_id": "jack_port_by_id",
    "is_mine": "jack_port_is_mine",
}
_SILENT = ctypes.CFUNCTYPE(None, _Text)(lambda _text: None)  # kept, since libjack calls it


@cache
def _libjack() -> ctypes.CDLL:
    for name in _LIBRARIES:
        try:
            library = ctypes.CDLL(ctypes.util.find_library(name) or name)
        except OSError:
            continue
        for function, (result, arguments) in _FUNCTIONS.items():
            found = getattr(library, function)
            found.restype, found.argtypes = result, arguments
        library.jack_set_error_function(_SILENT)
        library.jack_set_info_function(_SILENT)
        return library
    raise InputError("jack: libjack must be installed; Debian: apt install jackd2")


def _open_client() -> int:
    """A client of the running server; raises LinkError."""
    status = ctypes.c_int()
    client = _libjack().jack_client_open(CLIENT.encode(), _NO_START_SERVER, ctypes.byref(status))
    if not client:
        reason = "no server is running" if status.value & _SERVER_FAILED else "it refused a client"
        raise LinkError(
            f"jack: {reason} (status {status.value:#x}); start one, as in jackd -d alsa -r 48000 "
            "-p 128, by the same user; JACK_DEFAULT_SERVER names another than default"
        )
    return int(client)


def _names(listed: "ctypes._Pointer[_Text]") -> list[str]:
    names: list[str] = []
    if ctypes.cast(listed, _Pointer).value is not None:  # null for none
        while (name := listed[len(names)]) is not None:
            names.append(name.decode())
        _libjack().jack_free(ctypes.cast(listed, _Pointer))
    return names


def _inputs_of(client: int, destination: str) -> list[str]:
    """The ports that take samples, of a client by its name, or of the hardware."""
    flags = _IS_INPUT | (0 if destination else _IS_PHYSICAL)
    pattern = f"^{re.escape(destination)}:".encode() if destination else None
    return _names(_libjack().jack_get_ports(client, pattern, _AUDIO, flags))


def jack_devices() -> dict[str, int]:
    """Clients of the running server that take samples: their channels, by what --device takes.

    Raises InputError, LinkError.
    """
    client = _open_client()
    try:
        ports = _names(_libjack().jack_get_ports(client, None, _AUDIO, _IS_INPUT))
    finally:
        _libjack().jack_client_close(client)
    return {f"jack:{name}": n for name, n in Counter(p.split(":")[0] for p in ports).items()}


class JackOutput:
    """As many ports as the amplifier has channels, each connected to the next one of a client."""

    def __init__(self, settings: Settings, *, destination: str) -> None:
        self._client = _open_client()
        try:
            self._prepare(settings, destination)
        except BaseException:
            self.close()
            raise

    def _prepare(self, settings: Settings, destination: str) -> None:
        library = _libjack()
        rate = library.jack_get_sample_rate(self._client)
        if settings.rate not in (None, rate):
            raise InputError(
                f"--rate must be {rate} Hz, that of the JACK server, got {settings.rate}; start "
                f"the server with -r {settings.rate}, or omit --rate"
            )
        self.rate = check_rate(rate, what="JACK server")
        self.block = library.jack_get_buffer_size(self._client)
        if settings.block not in (None, self.block):
            raise InputError(
                f"--block must be {self.block} frames, those of the JACK server, got "
                f"{settings.block}; start the server with -p {settings.block}, or omit --block"
            )
        inputs = _inputs_of(self._client, destination)
        self.name = f"jack:{destination}" if destination else "jack"
        if not inputs:
            raise InputError(
                f"--device {self.name}: no such client, or it takes no samples; list devices with "
                "era soft-amp --list"
            )
        if len(inputs) < settings.channels:
            raise InputError(
                f"--channels must be at most {len(inputs)}, the ports of {self.name}, got "
                f"{settings.channels}"
            )
        self._inputs = inputs[: settings.channels]
        for name in self._inputs:
            port = library.jack_port_by_name(self._client, name.encode())
            users = _names(library.jack_port_get_all_connections(self._client, port))
            if users:
                raise LinkError(
                    f"--device {self.name}: busy, {users[0]} plays to {name}; end or disconnect it"
                )
        flags = _IS_OUTPUT | _IS_TERMINAL
        self._ports = [
            library.jack_port_register(self._client, f"out_{n}".encode(), _AUDIO, flags, 0)
            for n in range(1, settings.channels + 1)
        ]
        if None in self._ports:
            raise LinkError("jack: the server has no more ports; start it with a larger -p (ports)")

    def start(self, engine: Engine) -> None:
        """Connect, and let JACK call the engine; raises LinkError."""
        library = _libjack()
        calls = JackCalls(client=self._client)
        calls.ports[: len(self._ports)] = self._ports
        for field, name in _CALLED_BY_ENGINE.items():
            setattr(calls, field, ctypes.cast(getattr(library, name), _Pointer))
        engine.use_jack(calls)
        set_ = {
            "sound_jack_process": library.jack_set_process_callback,
            "sound_jack_xrun": library.jack_set_xrun_callback,
            "sound_jack_shutdown": library.jack_on_shutdown,
            "sound_jack_connect": library.jack_set_port_connect_callback,
        }
        for callback, set_callback in set_.items():
            set_callback(self._client, engine.address(callback), None)
        if library.jack_activate(self._client):
            raise LinkError("jack: the server did not activate the client")
        for port, name in zip(self._ports, self._inputs, strict=True):
            if library.jack_connect(self._client, library.jack_port_name(port), name.encode()):
                raise LinkError(f"jack: {name} could not be connected; it may have gone")

    def is_playing(self) -> bool:
        """Always, since JACK tells of a loss by its callbacks."""
        return True

    def close(self) -> None:
        """Leave the server."""
        _libjack().jack_client_close(self._client)

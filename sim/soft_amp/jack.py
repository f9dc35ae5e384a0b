"""The library of JACK, through ctypes: a client of a running server, and the ports of others."""

import ctypes
import ctypes.util
import re
from collections.abc import Iterable, Mapping
from functools import cache

from drivers.errors import LinkError
from model.errors import InputError
from registry.plugins import did_you_mean

_AUDIO = b"32 bit float mono audio"
IS_INPUT, IS_OUTPUT = 1, 2
"""Flags of ports: that take samples, and that give them."""
_IS_PHYSICAL, _IS_TERMINAL = 4, 16
_NO_START_SERVER, _USE_EXACT_NAME = 1, 2
_NAME_NOT_UNIQUE, _SERVER_FAILED = 0x04, 0x10
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
    "jack_port_get_buffer": (_Pointer, (_Pointer, ctypes.c_uint32)),
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
_SILENT = ctypes.CFUNCTYPE(None, _Text)(lambda _text: None)  # kept, since libjack calls it


@cache
def libjack() -> ctypes.CDLL:
    """The loaded library; raises InputError where there is none."""
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


class NoSound(LinkError):
    """No sound server runs, or it has no sound card yet: what may be waited for."""


class JackClient:
    """A client of the running server; rate [Hz], block [frames]: the server's.

    is_only: whether others find it by its name, which then must be free; otherwise the server may
    add a number to it. Raises LinkError.
    """

    def __init__(self, name: str, *, is_only: bool = False) -> None:
        status = ctypes.c_int()
        options = _NO_START_SERVER | (_USE_EXACT_NAME if is_only else 0)
        client = libjack().jack_client_open(name.encode(), options, ctypes.byref(status))
        if not client:
            if status.value & _NAME_NOT_UNIQUE:
                raise LinkError(
                    f"jack: a client named {name} is connected already; end it, or choose another "
                    "name"
                )
            is_down = status.value & _SERVER_FAILED
            reason = "no server is running" if is_down else "it refused a client"
            raise (NoSound if is_down else LinkError)(
                f"jack: {reason} (status {status.value:#x}); start one, as in jackd -d alsa "
                "-r 48000 -p 128, by the same user; JACK_DEFAULT_SERVER names another than default"
            )
        self.pointer = int(client)
        self.outputs: list[int] = []
        """Its own ports that give samples."""
        self.inputs: list[int] = []
        """Its own ports that take samples."""
        self._theirs: list[str] = []  # ports for these, in their order
        self.rate = int(libjack().jack_get_sample_rate(client))
        self.block = int(libjack().jack_get_buffer_size(client))

    def ports_of(self, other: str, flag: int) -> list[str]:
        """Ports of a client by its name, or of the hardware (""), with IS_INPUT or IS_OUTPUT."""
        flags = flag | (0 if other else _IS_PHYSICAL)
        pattern = f"^{re.escape(other)}:".encode() if other else None
        return _names(libjack().jack_get_ports(self.pointer, pattern, _AUDIO, flags))

    def first_ports(self, other: str, flag: int, count: int) -> list[str]:
        """The first of such ports, those that take samples free of other programs.

        Raises InputError where there are fewer, NoSound without a card, LinkError for busy ones.
        """
        found = self.ports_of(other, flag)
        what = "outputs" if flag == IS_INPUT else "inputs"  # of the other client
        if not found and count and not other:
            raise NoSound(f"jack: the server has no {what} of a sound card; check that it is found")
        if len(found) < count:
            known = [] if found else [name for name, *_ in self.clients() if name != other]
            raise InputError(
                f"--device {jack_name(other)} must have {count} {what}, got {len(found)}; "
                f"{did_you_mean(jack_name(other), map(jack_name, known))}list devices with "
                "era soft-amp --list"
            )
        if flag == IS_INPUT:
            self.check_free(found[:count], device=jack_name(other))
        return found[:count]

    def clients(self) -> list[tuple[str, int, int]]:
        """The hardware ("") and each client with ports of audio: name, outputs, inputs.

        Outputs are what it plays: ports that take samples.
        """
        ports = _names(libjack().jack_get_ports(self.pointer, None, _AUDIO, 0))
        names = dict.fromkeys(["", *(port.partition(":")[0] for port in ports)])
        return [
            (name, len(self.ports_of(name, IS_INPUT)), len(self.ports_of(name, IS_OUTPUT)))
            for name in names
        ]

    def connected_to(self, port: str) -> list[str]:
        """Ports that a port is connected to."""
        found = libjack().jack_port_by_name(self.pointer, port.encode())
        return _names(libjack().jack_port_get_all_connections(self.pointer, found))

    def check_free(self, ports: Iterable[str], *, device: str) -> None:
        """Raise LinkError for a port that another program plays to: both would add up."""
        for port in ports:
            users = self.connected_to(port)
            if users:
                raise LinkError(
                    f"--device {device}: busy, {users[0]} plays to {port}; end or disconnect it"
                )

    def wire(self, other: str | None, *, outputs: int = 0, inputs: int = 0) -> None:
        """Register ports out_1, ... and in_1, ..., each for the next free port of another client.

        other: its name, "" for the hardware, None to connect them to nothing. Raises InputError,
        LinkError as `first_ports`.
        """
        if other is not None:
            takers = self.first_ports(other, IS_INPUT, outputs)
            self._theirs = [*takers, *self.first_ports(other, IS_OUTPUT, inputs)]
        self.outputs = self._registered("out", outputs, IS_OUTPUT)
        self.inputs = self._registered("in", inputs, IS_INPUT)

    def _registered(self, name: str, count: int, flag: int) -> list[int]:
        """New ports of its own, numbered from 1; raises LinkError."""
        ports = [
            libjack().jack_port_register(
                self.pointer, f"{name}_{n + 1}".encode(), _AUDIO, flag | _IS_TERMINAL, 0
            )
            for n in range(count)
        ]
        if None in ports:
            raise LinkError("jack: the server has no more ports; start it with a larger -p (ports)")
        return ports

    def start(
        self, callbacks: Mapping[str, int | ctypes.c_void_p], given: int | None = None
    ) -> None:
        """Begin to be called, and connect the ports; raises LinkError.

        callbacks: addresses by the function of libjack that sets them; given: the address of what
        they are given.
        """
        for function, callback in callbacks.items():
            getattr(libjack(), function)(self.pointer, callback, given)
        if libjack().jack_activate(self.pointer):
            raise LinkError("jack: the server did not activate the client")
        own = [libjack().jack_port_name(port).decode() for port in (*self.outputs, *self.inputs)]
        for number, (one, other) in enumerate(zip(own, self._theirs, strict=False)):
            way = (one, other) if number < len(self.outputs) else (other, one)
            if libjack().jack_connect(self.pointer, *(port.encode() for port in way)):
                raise LinkError(f"jack: {other} could not be connected; it may have gone")

    def close(self) -> None:
        """Leave the server, once."""
        if self.pointer:
            libjack().jack_client_close(self.pointer)
        self.pointer = 0


def jack_name(other: str) -> str:
    """How a client is named as a device; "" for the hardware."""
    return f"jack:{other}" if other else "jack"


def _names(listed: "ctypes._Pointer[_Text]") -> list[str]:
    names: list[str] = []
    if ctypes.cast(listed, _Pointer).value is not None:  # null for none
        while (name := listed[len(names)]) is not None:
            names.append(name.decode())
        libjack().jack_free(ctypes.cast(listed, _Pointer))
    return names

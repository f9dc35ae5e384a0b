"""An output to the ports of a JACK client, by libjack itself."""

import ctypes

from model.errors import InputError
from sim.libjack import IS_INPUT, IS_OUTPUT, JackClient, libjack
from sim.soft_amp.engine import Engine, JackCalls
from sim.soft_amp.settings import Settings, check_rate

CLIENT = "era-soft-amp"

_CALLED_BY_ENGINE = {
    "buffer": "jack_port_get_buffer",
    "frame_time": "jack_last_frame_time",
    "is_realtime": "jack_is_realtime",
    "port_by_id": "jack_port_by_id",
    "is_mine": "jack_port_is_mine",
}


class JackOutput:
    """As many ports as the amplifier has channels, each connected to the next one of a client."""

    def __init__(self, settings: Settings, *, destination: str) -> None:
        self._client = JackClient(CLIENT)
        try:
            self._prepare(settings, destination)
        except BaseException:
            self.close()
            raise

    def _prepare(self, settings: Settings, destination: str) -> None:
        rate = self._client.rate
        if settings.rate not in (None, rate):
            raise InputError(
                f"--rate must be {rate} Hz, that of the JACK server, got {settings.rate}; start "
                f"the server with -r {settings.rate}, or omit --rate"
            )
        self.rate = check_rate(rate, what="JACK server")
        self.block = self._client.block
        if settings.block not in (None, self.block):
            raise InputError(
                f"--block must be {self.block} frames, those of the JACK server, got "
                f"{settings.block}; start the server with -p {settings.block}, or omit --block"
            )
        inputs = self._client.ports_of(destination, IS_INPUT)
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
        self._client.check_free(self._inputs, device=self.name)
        names = [f"out_{n}" for n in range(1, settings.channels + 1)]
        self._ports = self._client.register(names, IS_OUTPUT)

    def start(self, engine: Engine) -> None:
        """Connect, and let JACK call the engine; raises LinkError."""
        library = libjack()
        calls = JackCalls(client=self._client.pointer)
        calls.ports[: len(self._ports)] = self._ports
        for field, name in _CALLED_BY_ENGINE.items():
            setattr(calls, field, ctypes.cast(getattr(library, name), ctypes.c_void_p))
        engine.use_jack(calls)
        set_ = {
            "sound_jack_process": library.jack_set_process_callback,
            "sound_jack_xrun": library.jack_set_xrun_callback,
            "sound_jack_shutdown": library.jack_on_shutdown,
            "sound_jack_connect": library.jack_set_port_connect_callback,
        }
        for callback, set_callback in set_.items():
            set_callback(self._client.pointer, engine.address(callback), None)
        self._client.activate()
        for port, name in zip(self._ports, self._inputs, strict=True):
            self._client.connect(port, name)

    def is_playing(self) -> bool:
        """Always, since JACK tells of a loss by its callbacks."""
        return True

    def close(self) -> None:
        """Leave the server."""
        self._client.close()

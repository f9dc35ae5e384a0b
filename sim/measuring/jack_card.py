"""A sound card through JACK: the ports of the hardware, or of another client."""

import ctypes

from model.errors import InputError
from sim.libjack import IS_INPUT, IS_OUTPUT, JackClient, libjack
from sim.measuring.sound_card import Ports, SoundCard

CLIENT = "era-measure"


def activate(
    card: SoundCard, client: JackClient, *, outputs: int, inputs: int
) -> tuple[list[int], list[int]]:
    """Let a client's new ports out_1, ... and in_1, ... be those of a card; returns them."""
    out = client.register((f"out_{n + 1}" for n in range(outputs)), IS_OUTPUT)
    into = client.register((f"in_{n + 1}" for n in range(inputs)), IS_INPUT)
    library = libjack()
    ports = Ports(client=client.pointer)
    ports.outputs[: len(out)], ports.inputs[: len(into)] = out, into
    ports.buffer = ctypes.cast(library.jack_port_get_buffer, ctypes.c_void_p)
    ports.frame_time = ctypes.cast(library.jack_last_frame_time, ctypes.c_void_p)
    given = card.given(ports)
    for name, set_callback in (
        ("transfer_jack_process", library.jack_set_process_callback),
        ("transfer_jack_shutdown", library.jack_on_shutdown),
    ):
        set_callback(client.pointer, card.address(name), given)
    client.activate()
    return out, into


class JackCard(SoundCard):
    """Ports of its own, each connected to the next one of a client; "": of the hardware."""

    def __init__(self, other: str, *, outputs: int, inputs: int, limit: float) -> None:
        super().__init__(outputs=outputs, inputs=inputs, limit=limit)
        self.name = f"jack:{other}" if other else "jack"
        self._client = JackClient(CLIENT)
        self._is_open = True
        try:
            self.rate = float(self._client.rate)
            self._start(other, outputs, inputs)
        except BaseException:
            self.close()
            raise

    def _start(self, other: str, outputs: int, inputs: int) -> None:
        takers = self._theirs(other, IS_INPUT, outputs, what="outputs")
        givers = self._theirs(other, IS_OUTPUT, inputs, what="inputs")
        self._client.check_free(takers, device=self.name)
        out, into = activate(self, self._client, outputs=outputs, inputs=inputs)
        for port, taker in zip(out, takers, strict=True):
            self._client.connect(port, taker)
        for giver, port in zip(givers, into, strict=True):
            self._client.connect(giver, port)

    def _theirs(self, other: str, flag: int, count: int, *, what: str) -> list[str]:
        """The first ports of the other client."""
        found = self._client.ports_of(other, flag)
        if len(found) < count:
            raise InputError(
                f"--device {self.name} must have {count} {what}, got {len(found)}"
                + ("; list devices with era soft-amp --list" if not found else "")
            )
        return found[:count]

    def close(self) -> None:
        """Leave the server."""
        if self._is_open:
            self._is_open = False
            self._client.close()

"""What an amplifier plays through: a device that PortAudio or JACK has opened."""

from typing import Protocol

from sim.soft_amp.engine import Engine
from sim.soft_amp.settings import Settings


class Output(Protocol):
    """An open device; its callback is called from `start` on.

    name: of the device; rate [Hz]; block: frames of a callback, 0 if it varies.
    """

    name: str
    rate: int
    block: int

    def start(self, engine: Engine) -> None:
        """Begin to play; raises LinkError."""

    def is_playing(self) -> bool:
        """Whether the device still takes samples."""

    def close(self) -> None:
        """Stop, and leave the device."""


def open_output(settings: Settings) -> Output:
    """Open the device of an amplifier; InputError, LinkError where it is busy or gone."""
    kind, _, name = settings.device.partition(":")
    if kind == "jack":
        from sim.soft_amp.jack import JackOutput

        return JackOutput(settings, destination=name)
    from sim.soft_amp.portaudio import PortAudioOutput

    return PortAudioOutput(settings)

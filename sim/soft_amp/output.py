"""What an amplifier plays through: a device that PortAudio or JACK has opened."""

from typing import TYPE_CHECKING, TypeAlias

from sim.soft_amp.settings import Settings

if TYPE_CHECKING:
    from sim.soft_amp.jack import JackOutput
    from sim.soft_amp.portaudio import PortAudioOutput

Output: TypeAlias = "JackOutput | PortAudioOutput"
"""An open device with its name, rate [Hz] and block [frames], 0 if it varies; see either."""


def open_output(settings: Settings) -> Output:
    """Open the device of an amplifier; InputError, LinkError where it is busy or gone."""
    kind, _, name = settings.device.partition(":")
    if kind == "jack":
        from sim.soft_amp.jack import JackOutput

        return JackOutput(settings, destination=name)
    from sim.soft_amp.portaudio import PortAudioOutput

    return PortAudioOutput(settings)

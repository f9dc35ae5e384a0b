"""What can play and record: clients of the JACK server, and devices of PortAudio."""

from collections.abc import Iterator
from contextlib import closing
from dataclasses import asdict, dataclass
from typing import Any

from drivers.errors import LinkError
from model.errors import InputError
from sim.desk.libjack import JackClient, jack_name
from sim.desk.soft_amp.output import default_block, sounddevice


@dataclass(frozen=True)
class Device:
    """A device; device: what `--device` takes; block_frames: of a block, by default.

    rate_hz: that of the server, which has no other, or the default of a device of PortAudio.
    """

    device: str
    host: str
    name: str
    outputs: int
    inputs: int
    rate_hz: int
    block_frames: int

    def __str__(self) -> str:
        """The device in one line."""
        name = "" if self.name in self.device else f"{self.name}, {self.host}: "
        return (
            f"{self.device}: {name}{self.outputs} outputs, {self.inputs} inputs, {self.rate_hz} "
            f"Hz, blocks of {self.block_frames} frames"
        )


def jack_devices() -> Iterator[Device]:
    """The hardware of the JACK server, and its clients; raises InputError, LinkError."""
    with closing(JackClient("era-list")) as client:
        for name, outputs, inputs in client.clients():
            if outputs + inputs:
                title = name or "hardware"
                yield Device(
                    jack_name(name), "JACK", title, outputs, inputs, client.rate, client.block
                )


def portaudio_devices() -> Iterator[Device]:
    """The devices of PortAudio, by their numbers; raises InputError."""
    library = sounddevice()
    hosts = library.query_hostapis()
    for number, each in enumerate(library.query_devices()):
        yield Device(
            str(number),
            hosts[each["hostapi"]]["name"],
            each["name"],
            each["max_output_channels"],
            each["max_input_channels"],
            round(each["default_samplerate"]),
            default_block(),
        )


def listed_devices() -> tuple[list[str], dict[str, Any]]:
    """All devices as lines and for programs, with what is missing and why."""
    found: list[Device] = []
    missing: list[dict[str, str]] = []
    for host, devices in (("JACK", jack_devices), ("PortAudio", portaudio_devices)):
        try:
            found += devices()
        except (InputError, LinkError) as problem:
            missing.append({"host": host, "reason": str(problem)})
    rows = [*map(str, found), *(f"no {each['host']}: {each['reason']}" for each in missing)]
    return rows, {"devices": [asdict(each) for each in found], "missing": missing}

"""What can play and record: clients of the JACK server, and devices of PortAudio."""

from collections.abc import Iterator
from contextlib import closing
from typing import Any, TypeAlias

from drivers.errors import LinkError
from model.errors import InputError
from sim.desk.libjack import JackClient, jack_name
from sim.desk.soft_amp.output import default_block, sounddevice

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

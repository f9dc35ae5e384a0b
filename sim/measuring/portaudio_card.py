"""A sound card through PortAudio, by python-sounddevice."""

from typing import Any

from drivers.errors import LinkError
from model.errors import InputError
from sim.measuring.sound_card import SoundCard
from sim.soft_amp.portaudio import check_free, sounddevice

_BLOCK = 512  # frames; late samples are worse than a delay, which is measured


class PortAudioCard(SoundCard):
    """One stream in both directions, of one device: two devices would have two clocks."""

    def __init__(self, device: str, *, outputs: int, inputs: int, limit: float) -> None:
        super().__init__(outputs=outputs, inputs=inputs, limit=limit)
        library = sounddevice()
        number: int | str = int(device) if device.isdecimal() else device
        try:
            found = library.query_devices(number)
        except (ValueError, library.PortAudioError) as problem:
            raise InputError(
                f"--device {device}: {str(problem).splitlines()[0]}; list devices with "
                "era soft-amp --list"
            ) from None
        self.name, self.rate = found["name"], float(found["default_samplerate"])
        for what, count, offered in (
            ("outputs", outputs, found["max_output_channels"]),
            ("inputs", inputs, found["max_input_channels"]),
        ):
            if offered < count:
                raise InputError(f"--device {self.name} must have {count} {what}, got {offered}")
        if outputs:
            check_free(library, found, outputs)
        given = self.given()
        ffi = library._ffi
        kind = "duplex" if outputs and inputs else "input" if inputs else "output"
        channels: Any = {"duplex": (inputs, outputs), "input": inputs, "output": outputs}[kind]
        try:
            # The one class that takes a callback of C; for authors of libraries, as it says.
            self._stream: Any = library._StreamBase(
                kind=kind,
                samplerate=self.rate,
                blocksize=_BLOCK,
                device=found["index"],
                channels=channels,
                dtype="float32",
                latency="high",
                callback=ffi.cast("PaStreamCallback *", self.address("transfer_portaudio")),
                clip_off=True,
                dither_off=True,
                userdata=ffi.cast("void *", given),
            )
            self._stream.start()
        except library.PortAudioError as problem:
            raise LinkError(
                f"--device {self.name}: cannot be opened: {problem.args[0]}; end the program that "
                "uses it"
            ) from None

    def close(self) -> None:
        """Stop at once, and close the device."""
        self._stream.close(ignore_errors=True)

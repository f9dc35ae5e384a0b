"""A backend for two-channel signal generators that speak SCPI, such as Keysight's 33500B series.

    scpi://HOST[:5025]?full_voltage=5&bias=0.4        over TCP
    scpi+serial:///dev/ttyUSB0?baud=115200            over a serial port

The words are those of the Keysight 33500B/33600A Operating and Service Guide. full_voltage [V]:
the peak at level 1, into an open circuit; bias: constant part, as a share of it, as in the rig.
"""

from collections.abc import Sequence
from itertools import chain
from urllib.parse import parse_qsl, urlsplit

from era_haptics.plugins.backends import (
    Capabilities,
    CommandError,
    CommandRefused,
    DriveCommand,
    Feature,
    ForeignAmplifier,
    Identity,
    TextLine,
    now,
)

CHANNELS = (1, 2)
MIN_VPP = 0.002  # V, into an open circuit
MAX_PEAK = 10.0  # V, peak with bias, into an open circuit
SAME_FREQUENCY = 1e-5  # Hz; below every step
OPTIONS = {"full_voltage": 5.0, "bias": 0.0, "baud": 115_200.0}
IS_ON = {"1": True, "ON": True, "0": False, "OFF": False}


class ScpiBackend(ForeignAmplifier):
    """A generator at a URL."""

    def __init__(self, url: str) -> None:
        options = dict(OPTIONS)
        try:
            parts = urlsplit(url)
            host, place = parts.hostname, parts.path
            for name, value in parse_qsl(parts.query, strict_parsing=bool(parts.query)):
                options[name] = float(value)
            port = f"socket://{host}:{parts.port or 5025}" if host else place
        except ValueError:
            port = ""
        is_serial = parts.scheme == "scpi+serial" if port else False
        if not port or is_serial == bool(host) or options.keys() != OPTIONS.keys():
            raise CommandError(
                f"URL must be scpi://HOST[:PORT] or scpi+serial:///dev/ttyUSB0, with "
                f"{', '.join(OPTIONS)} at most as options, got {url!r}"
            )
        super().__init__(port)
        self._full, self._bias = options["full_voltage"], options["bias"]
        if not (MIN_VPP < self._full <= MAX_PEAK and 0 <= self._bias < 1):
            raise CommandError(f"full_voltage must be up to {MAX_PEAK:g} V, bias below 1: {url!r}")
        self._line = TextLine(
            port, baud=int(options["baud"]), on_loss=lambda cause: self._on_loss(cause)
        )
        self._number = 0

    async def open(self) -> None:
        """Open the line."""
        await self._line.open()

    async def close(self) -> None:
        """Close the line."""
        await super().close()
        await self._line.close()

    async def identify(self) -> Identity:
        """Read its name."""
        (names,) = await self._ask("*IDN?")
        vendor, product, serial_number, firmware = (names + ",,,").split(",")[:4]
        return Identity(vendor, product, serial_number, firmware, versions=(2,))

    def capabilities(self) -> Capabilities:
        """Two sines with phases, of a voltage; no ramps, nothing that happens by itself."""
        return Capabilities(
            channels=len(CHANNELS),
            frequency_min=1.0,
            frequency_max=3000.0,
            frequency_step=0.05,
            level_max=1.0,
            level_step=max(MIN_VPP / (2 * self._full), 1e-4),
            phase_step=0.01,
            ramp_max=0.0,
            watchdog_min=0.0,
            watchdog_max=0.0,
            envelope_knots=0,
            features=Feature.PHASE | Feature.VOLTAGE,
            has_cross_fades=False,
        )

    async def prepare(self) -> None:
        """Switch the outputs off, and set up sines in volts and degrees."""
        words = ["*CLS", "OUTP1 OFF", "OUTP2 OFF", "UNIT:ANGL DEG"]
        for n in CHANNELS:
            words += [f"OUTP{n}:LOAD INF", f"SOUR{n}:FUNC SIN", f"SOUR{n}:VOLT:UNIT VPP"]
            words += [f"SOUR{n}:VOLT MIN", f"SOUR{n}:VOLT:OFFS {self._bias * self._full:.6g}"]
        await self._set(words)

    async def play(self, commands: Sequence[DriveCommand]) -> Sequence[DriveCommand]:
        """Set frequencies, voltages and phases; all tones start together unless one continues.

        PHAS:SYNC restarts both channels. Beside a tone that continues, one that begins has the time
        of its phase generator, which is not that of the commit: both are reported with keep_phase.
        """
        sounding = [one for one in commands if self._vpp(one) > 0]
        before = await self._of_outputs("FREQ")
        words = [f"OUTP{n} OFF" for n in CHANNELS if n - 1 not in {one.channel for one in sounding}]
        for one in sounding:
            n = one.channel + 1
            words += [f"SOUR{n}:FREQ {one.frequency:.10g}", f"SOUR{n}:VOLT {self._vpp(one):.6g}"]
            words += [f"SOUR{n}:PHAS {one.phase:.6g}", f"OUTP{n} ON"]
        continues = any(
            one.keep_phase and abs(before[one.channel] - one.frequency) < SAME_FREQUENCY
            for one in sounding
        )
        if sounding and not continues:
            words += ["*WAI", "SOUR1:PHAS:SYNC"]  # after the relays; of both channels
        await self._set(words)
        return [await self._played(one, keep_phase=continues) for one in sounding]

    async def silence(self) -> None:
        """Switch both outputs off."""
        await self._ask("OUTP1 OFF", "OUTP2 OFF", "*OPC?")

    async def levels(self) -> Sequence[float]:
        """Read the outputs and their voltages."""
        return [vpp / (2 * self._full) for vpp in await self._of_outputs("VOLT")]

    async def _of_outputs(self, what: str) -> list[float]:
        """Read a number of each channel, 0 where its output is off."""
        questions = ((f"OUTP{n}?", f"SOUR{n}:{what}?") for n in CHANNELS)
        found = await self._ask(*chain.from_iterable(questions))
        pairs = zip(found[::2], found[1::2], strict=True)
        return [IS_ON[on] * float(number) for on, number in pairs]

    def _vpp(self, command: DriveCommand) -> float:
        """Peak to peak, 0 below half of the minimum."""
        vpp = 2 * self._full * command.level
        return max(vpp, MIN_VPP) if vpp >= MIN_VPP / 2 else 0.0

    async def _played(self, command: DriveCommand, *, keep_phase: bool) -> DriveCommand:
        """Read back what a channel plays."""
        source = f"SOUR{command.channel + 1}"
        found = await self._ask(f"{source}:FREQ?", f"{source}:VOLT?", f"{source}:PHAS?")
        frequency, vpp, phase = map(float, found)
        return DriveCommand(command.channel, frequency, vpp / (2 * self._full), phase, keep_phase)

    async def _set(self, words: Sequence[str]) -> None:
        """Send words, and read what the generator says of them; silent after an error."""
        _, error = await self._ask(*words, "*OPC?", "SYST:ERR?")
        if int(error.split(",")[0]):
            await self.silence()
            await self._ask("*CLS", "*OPC?")
            raise CommandRefused(f"the generator reports {error}; its outputs are off")

    async def _ask(self, *words: str) -> list[str]:
        """Send words in one line; returns the answers to its questions.

        IEEE 488.2 does not number replies. The event status enable register, which nothing here
        uses, is written and read back first: a late reply has another number.
        """
        self._number = self._number % 255 + 1
        line = ";".join(word if word[0] == "*" else f":{word}" for word in words)
        self._line.send(f"*ESE {self._number};*ESE?;{line}")
        self._last_sent_at = now()
        self._counters.frames_out += 1
        count = sum(word.endswith("?") for word in words)
        while True:
            number, *answers = (await self._line.read()).split(";", count)
            self._counters.frames_in += 1
            if number.lstrip("+") == str(self._number) and len(answers) == count:
                return answers
            self._counters.unexpected_frames += 1

"""The software amplifier: its settings, its clock, and its sound server.

What it refuses before any device is opened; the clock as a made-up JACK server says when a block is
played; samples as a client of a real JACK server captures them; and the fault that hosts see while
the amplifier waits for its server.
"""

import asyncio
import ctypes
import json
import multiprocessing
import os
import signal
import socket
import struct
import subprocess
from collections.abc import Awaitable, Callable, Iterator
from dataclasses import asdict, dataclass, replace
from multiprocessing.connection import Connection
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from cobs import cobs

from cases import shortly
from drivers.host.amplifier import Amplifier
from drivers.opening import Lines
from drivers.protocol.definition import FAULTS, STATES
from kit import hand_frames as hand
from model.errors import InputError
from processes.desk import Capture
from processes.gateways import wait_for
from processes.sound_cards import BLOCK as CARD_BLOCK
from processes.sound_cards import RATE as CARD_RATE
from processes.sound_cards import SoftAmp, capture_on, host, jack_server
from processes.steady_host import WATCHDOG, linear_amplifier
from processes.typed_page import ERA
from sim.soft_amp.engine import (
    Counters,
    JackCalls,
    compile_engine,
    library,
    start_engine,
    take_over,
)
from sim.soft_amp.jack import NoSound
from sim.soft_amp.output import PortAudioOutput, open_output, portaudio_stream
from sim.soft_amp.settings import (
    Law,
    Protocol,
    SoftAmplifierLine,
    SoftAmplifierSettings,
    terminal_place,
)

CHANNELS = 2
RATE = 96_000  # not the one that is assumed until the server says its own


@pytest.mark.real_time
@pytest.mark.needs("jackd", "cc")
async def test_amplifier_waits_for_its_server_and_plays_by_the_clock_of_that(
    tmp_path: Path,
) -> None:
    """In fault at first, reported once; then 1 kHz is 1 kHz at a rate that was not stated."""
    name = f"wait{os.getpid()}"
    environment = os.environ | {"JACK_DEFAULT_SERVER": name, "JACK_NO_START_SERVER": "1"}
    options = ("--device", "jack:card", "--channels", str(CHANNELS), "--link", str(tmp_path / "a"))
    amp = SoftAmp(*options, environment=environment, log=tmp_path / "log")
    lines = Lines()
    amplifier = await linear_amplifier(lines, amp.url)
    await amplifier.open()
    status = await amplifier.read_status()
    assert (status["state"], status["fault"]) == (STATES["FAULT"], FAULTS["INTERNAL"])
    wait_for(lambda: "no server is running" in amp.log)
    await asyncio.sleep(1.5)  # two more attempts
    with jack_server(name, rate=RATE):
        capture = capture_on(name, "card", CHANNELS)
        wait_for(lambda: f"{RATE} Hz, blocks of {CARD_BLOCK} frames" in amp.log)
        assert amp.log.count("no server is running") == 1
        assert (await amplifier.read_status())["state"] == STATES["FAULT"]
        assert (await amplifier.clear())["state"] == STATES["SWITCH_ON_DISABLED"]
        await lines.close()
        with host(amp.url, CHANNELS):
            wait_for(capture.is_sounding)
            end = capture.position + 0.3 * RATE  # 0.2 s of soft start and ramp
            wait_for(lambda: capture.position > end)
            samples = capture.samples(RATE // 10)
        turning = np.exp(-2j * np.pi * 1000 * np.arange(len(samples)) / RATE)
        amplitudes = 2 * np.abs((samples * turning[:, None]).mean(axis=0))
        np.testing.assert_allclose(20 * np.log10(amplitudes / 0.5), 0, atol=0.1)
        amp.end()
        capture.close()


@pytest.mark.real_time
@pytest.mark.needs("jackd", "cc")
def test_devices_are_listed_with_outputs_inputs_rate_and_block() -> None:
    """Those of a dummy server of 4 outputs and 3 inputs, and why a host is missing; exit 0."""
    name = f"list{os.getpid()}"
    with jack_server(name, rate=RATE, inputs=3, outputs=4) as server:
        capture = capture_on(name, "card", CHANNELS)
        found = _listed(server.environment)["devices"]
        capture.close()
    by_name = {each["device"]: each for each in found if each["host"] == "JACK"}
    common = {"host": "JACK", "rate_hz": RATE, "block_frames": CARD_BLOCK}
    assert by_name["jack"] == common | {
        "device": "jack", "name": "hardware", "outputs": 4, "inputs": 3,
    }  # fmt: skip
    assert by_name["jack:card"] == common | {
        "device": "jack:card", "name": "card", "outputs": CHANNELS, "inputs": 0,
    }  # fmt: skip
    without = _listed(os.environ | {"JACK_DEFAULT_SERVER": f"none{os.getpid()}"})
    assert "no server is running" in without["missing"][0]["reason"]


def _listed(environment: dict[str, str]) -> dict[str, list[dict[str, object]]]:
    done = subprocess.run(
        [ERA, "soft-amp", "--list", "--json"], capture_output=True, env=environment, check=True
    )
    return json.loads(done.stdout)  # type: ignore[no-any-return]


SOFT_AMP_CLOCK_RATE, BLOCK = 48_000, 128
TURN = 20.0  # s
TOLERANCE = 2e-8  # s; four steps of the clock


@dataclass
class MadeUpJack:
    """A server whose cycles begin when they are due; late [us]: by which it calls the engine."""

    frame: int = 0
    latency: int = 0
    late: int = 0

    def __post_init__(self) -> None:
        self._block = (ctypes.c_float * BLOCK)()
        pointer, number = ctypes.c_void_p, ctypes.c_int
        times = [pointer, *(ctypes.POINTER(each) for each in (ctypes.c_uint32, ctypes.c_uint64))]
        self._kept = {
            "buffer": self._made(
                lambda *_: ctypes.addressof(self._block), pointer, pointer, number
            ),
            "cycle_times": self._made(self._cycle, number, *times, pointer, pointer),
            "time": self._made(lambda: self._due + self.late, ctypes.c_uint64),
            "latency": self._made(
                self._latency, None, pointer, number, ctypes.POINTER(ctypes.c_uint32)
            ),
            "is_realtime": self._made(lambda _: 0, number, pointer),
        }

    @staticmethod
    def _made(function: Callable[..., object], *types: object) -> ctypes._CFuncPtr:
        return ctypes.CFUNCTYPE(*types)(function)

    @property
    def _due(self) -> int:
        return round(self.frame * 1e6 / SOFT_AMP_CLOCK_RATE)

    def _cycle(self, _: int, frame: ctypes.Array, at: ctypes.Array, *__: object) -> int:
        frame[0], at[0] = self.frame, self._due
        return 0

    def _latency(self, _: int, mode: int, found: ctypes.Array) -> None:
        found[0], found[1] = self.latency, self.latency * (mode == 1)  # of playback

    def calls(self) -> JackCalls:
        """What the engine calls."""
        calls = JackCalls()
        for name, made in self._kept.items():
            setattr(calls, name, ctypes.cast(made, ctypes.c_void_p))
        return calls


def play(results: Connection) -> None:
    """Send what clocks [s] an engine shows, less the frames that came out before their blocks.

    At first; then with a latency and a late call; then behind a hole of 480 frames.
    """
    jack, counters = MadeUpJack(), Counters()
    host, terminal = socket.socketpair()
    terminal.setblocking(False)
    settings = SoftAmplifierSettings("jack", 2, Protocol.SERIAL, "S")
    start_engine(
        settings, rate=SOFT_AMP_CLOCK_RATE, counters=counters, is_recovering=False,
        terminal=terminal.fileno(), listening=-1, parent=-1,
    )  # fmt: skip
    library().sound_use_jack(ctypes.byref(jack.calls()))
    take_over()

    def run(served: int) -> int:
        """Let the server go on until so many requests were served; return the last frame."""
        since = jack.frame
        while counters.requests < served:
            since = jack.frame
            library().sound_jack_process(BLOCK, None)
            jack.frame += BLOCK
        return since

    def clock() -> float:
        host.sendall(hand.frame(hand.GET_STATUS, sequence=1))
        since = run(counters.requests + 1)
        data = b""
        while data.count(b"\0") < 2:
            data += host.recv(300)
        words = struct.unpack_from("<9H", cobs.decode(data.strip(b"\0")), 5)
        return float((words[7] << 16 | words[8]) / 2**32 * TURN - since / SOFT_AMP_CLOCK_RATE)

    run(1)  # the host is there
    shown = [clock()]
    jack.latency, jack.late = 384, 70
    shown.append(clock())
    jack.frame += 480
    shown.append(clock())
    results.send(shown)


@pytest.mark.needs("cc")
def test_clock_is_that_at_the_output() -> None:
    """Behind the samples by what the server holds, between them too; and lost ones count.

    In a process of its own, since the engine's threads have no end.
    """
    library()
    forked = multiprocessing.get_context("fork")
    results, theirs = forked.Pipe(duplex=False)
    process = forked.Process(target=play, args=(theirs,), daemon=True)
    process.start()
    try:
        assert results.poll(60)
        first, *others = results.recv()
    finally:
        process.kill()
        process.join()
    for other in others:
        behind = (first - other) % TURN
        assert behind == pytest.approx(384 / SOFT_AMP_CLOCK_RATE - 70e-6, abs=TOLERANCE)


def settings(**changed: object) -> SoftAmplifierSettings:
    """Settings of four channels, changed."""
    values: dict[str, object] = {
        "device": "jack",
        "channels": 4,
        "protocol": Protocol.SERIAL,
        "serial_number": "S",
    }
    return SoftAmplifierSettings(**(values | changed))  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("changed", "key"),
    [
        ({"channels": 1}, "--channels"),
        ({"channels": 33}, "--channels"),
        ({"channels": 19}, "--channels"),
        ({"limit": 0.0}, "--limit"),
        ({"limit": 0.7, "law": Law.SQUARE}, "--limit"),
        ({"rate": 44_100}, "--rate"),
    ],
)
def test_settings_out_of_range_are_refused(changed: dict[str, object], key: str) -> None:
    """By the option at fault; the square law leaves no force below a limit of 0.707."""
    with pytest.raises(InputError, match=key):
        settings(**changed)


def test_more_than_16_channels_are_two_amplifiers() -> None:
    """At addresses 1 and 2 of a serial line, units 1 and 2 of Modbus; settings pass as text."""
    given = settings(channels=18, law=Law.SQUARE, limit=0.9)
    assert SoftAmplifierSettings(**json.loads(json.dumps(asdict(given)))) == given
    assert SoftAmplifierLine("serial:///x").urls(given.amplifiers, protocol=Protocol.SERIAL) == [
        "serial:///x",
        "serial:///x?address=2",
    ]
    urls = SoftAmplifierLine("modbus+tcp://h:1").urls(given.amplifiers, protocol=Protocol.MODBUS)
    assert urls == ["modbus+tcp://h:1/1", "modbus+tcp://h:1/2"]


def test_no_compiler_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """With what to install."""
    monkeypatch.setenv("CC", "no-such-compiler")
    with pytest.raises(InputError, match="no-such-compiler"):
        compile_engine(tmp_path / "engine.so")


def test_link_follows_the_terminal_and_has_one_user(tmp_path: Path) -> None:
    """It leads to the terminal while that is open; a file in its place is left alone."""
    link = tmp_path / "amp"
    with terminal_place(link) as place:
        assert place.url == f"serial://{link}"
        assert link.readlink().is_char_device()
        with pytest.raises(InputError, match="in use"), terminal_place(link):
            pass
    assert not link.is_symlink()
    link.write_text("mine")
    with pytest.raises(InputError, match="no symbolic link"), terminal_place(link):
        pass
    assert link.read_text() == "mine"


@pytest.mark.parametrize("is_realtime", [False, True])
def test_block_is_shorter_than_a_reply_may_take(
    is_realtime: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """At 48 kHz, with and without real-time priority: the page allows 10 ms."""
    names = ("_terminate", "_initialize", "check_output_settings")
    library = SimpleNamespace(**dict.fromkeys(names, lambda *given, **others: None))
    device = {"name": "card", "index": 0, "default_samplerate": 48_000.0}
    monkeypatch.setattr("sim.soft_amp.output.sounddevice", lambda: library)
    monkeypatch.setattr("sim.soft_amp.output.portaudio_device", lambda *_, **others: device)
    monkeypatch.setattr("sim.soft_amp.output.may_be_realtime", lambda: is_realtime)
    output = PortAudioOutput(settings(device="card"))
    assert output.block / output.rate < 0.01


class _NoSound(Exception):
    """What PortAudio raises."""


@pytest.mark.parametrize(
    ("known", "is_down", "problem", "cause"),
    [
        ([], True, NoSound, "start its sound server"),
        ([], False, NoSound, "connect a sound card"),
        (["Scarlett 4i4"], False, InputError, "did you mean Scarlett 4i4"),
    ],
)
def test_portaudio_without_its_host_is_waited_for(
    known: list[str],
    is_down: bool,
    problem: type[Exception],
    cause: str,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """As where it cannot begin, or has no device at all; among others a name is mistyped."""

    def initialize() -> None:
        if is_down:
            raise _NoSound("Unanticipated host error")

    def query(number: object = None, _kind: object = None) -> object:
        if number is None:
            return [{"name": name} for name in known]
        raise ValueError(f"No output device matching {number!r}")

    library = SimpleNamespace(
        _terminate=lambda: None,
        _initialize=initialize,
        query_devices=query,
        PortAudioError=_NoSound,
    )
    monkeypatch.setattr("sim.soft_amp.output.sounddevice", lambda: library)
    with pytest.raises(problem, match=cause):
        PortAudioOutput(settings(device="Scarlet 4i4"))


class _Busy:
    """A stream that cannot be started, as one of a device that was taken since."""

    is_closed = False

    def __init__(self, **options: object) -> None: ...

    def start(self) -> None:
        """Fail as PortAudio does."""
        raise OSError("Device unavailable")

    def close(self, *, ignore_errors: bool) -> None:
        """Note it."""
        _Busy.is_closed = ignore_errors


def test_stream_that_does_not_start_is_closed(monkeypatch: pytest.MonkeyPatch) -> None:
    """Or its device would stay taken until the program ends."""
    library = SimpleNamespace(_StreamBase=_Busy, _ffi=SimpleNamespace(cast=lambda *_: None))
    monkeypatch.setattr("sim.soft_amp.output.sounddevice", lambda: library)
    with pytest.raises(OSError, match="unavailable"):
        portaudio_stream(0, 0, 0, outputs=2)
    assert _Busy.is_closed


PLAYED_CHANNELS = 3
SETTINGS = SoftAmplifierSettings(
    device="jack:card", channels=2, protocol=Protocol.SERIAL, serial_number="S"
)
SILENCE = 0.05  # s of samples; what the command promises once it is killed


@pytest.fixture(scope="module")
def sound(tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[Capture, dict[str, str]]]:
    """A client that captures, and the environment in which its server is found."""
    name = f"era{os.getpid()}"
    with jack_server(name) as server:
        capture = capture_on(name, "card", PLAYED_CHANNELS)
        yield capture, server.environment
        capture.close()


@pytest.fixture(scope="module")
def amp(
    sound: tuple[Capture, dict[str, str]], tmp_path_factory: pytest.TempPathFactory
) -> Iterator[SoftAmp]:
    """An amplifier that plays to it, through JACK itself."""
    folder = tmp_path_factory.mktemp("amp")
    options = (
        "--device",
        "jack:card",
        "--channels",
        str(PLAYED_CHANNELS),
        "--link",
        str(folder / "amp"),
    )
    soft_amp = SoftAmp(*options, environment=sound[1], log=folder / "log")
    yield soft_amp
    soft_amp.end()


@pytest.mark.real_time
@pytest.mark.needs("jackd", "cc")
def test_samples_are_those_of_the_page(sound: tuple[Capture, dict[str, str]], amp: SoftAmp) -> None:
    """Level x sin(2 pi f t + phase) within 0.1 dB, and within 0.1 degrees between channels."""
    capture, _ = sound
    with host(amp.url, PLAYED_CHANNELS) as playing:
        wait_for(capture.is_sounding)
        _wait_for_samples(capture, 0.3)  # 0.2 s of soft start and ramp
        samples = capture.samples(CARD_RATE // 10)
        turning = np.exp(-2j * np.pi * 1000 * np.arange(len(samples)) / CARD_RATE)
        amplitudes = 2 * (samples * turning[:, None]).mean(axis=0)
        np.testing.assert_allclose(20 * np.log10(np.abs(amplitudes) / 0.5), 0, atol=0.1)
        steps = np.degrees(np.angle(amplitudes[1:] / amplitudes[:-1]))
        np.testing.assert_allclose(steps, 30, atol=0.1)
        playing.kill()
        killed = capture.position
        wait_for(lambda: not capture.is_sounding())
        assert capture.end_of_sound() - killed < CARD_RATE * (WATCHDOG + SILENCE)


@pytest.mark.real_time
@pytest.mark.needs("jackd", "cc")
@pytest.mark.parametrize("how", [signal.SIGKILL, signal.SIGSTOP])
async def test_killed_or_stopped_player_is_silent_and_then_in_fault(
    sound: tuple[Capture, dict[str, str]], amp: SoftAmp, how: signal.Signals
) -> None:
    """No sound once it is gone; its line stays, reports the fault, and is disarmed once cleared."""
    capture, _ = sound
    with host(amp.url, PLAYED_CHANNELS):
        wait_for(capture.is_sounding)
        player, reopened = amp.player, amp.log.count("open again")
        os.kill(player, how)
        done = capture.position
        wait_for(lambda: amp.log.count("open again") > reopened)
        assert capture.end_of_sound() - done < CARD_RATE * SILENCE
        assert amp.player != player
    lines = Lines()
    amplifier = await linear_amplifier(lines, amp.url)
    await amplifier.open()
    status = await amplifier.read_status()
    assert (status["state"], status["fault"]) == (STATES["FAULT"], FAULTS["INTERNAL"])
    assert (await amplifier.clear())["state"] == STATES["SWITCH_ON_DISABLED"]
    await lines.close()


@pytest.mark.real_time
@pytest.mark.needs("jackd", "cc")
async def test_silence_is_an_open_output_of_zeros(
    sound: tuple[Capture, dict[str, str]], tmp_path: Path
) -> None:
    """After a lost host, a stop and a disarm: connected, no gap, and every sample exactly zero."""
    _, environment = sound
    here = capture_on(environment["JACK_DEFAULT_SERVER"], "zeros", 2)
    options = ("--device", "jack:zeros", "--channels", "2", "--link", str(tmp_path / "amp"))
    soft_amp = SoftAmp(*options, environment=environment, log=tmp_path / "log")
    lines = Lines()

    async def silent(end: Callable[[Amplifier], Awaitable[object]] | None) -> None:
        with host(soft_amp.url, 2) as playing:
            wait_for(here.is_sounding)
            playing.kill()
            playing.wait()
        if end is not None:
            amplifier = await linear_amplifier(lines, soft_amp.url)
            await amplifier.open()
            await end(amplifier)
            await lines.close()
        wait_for(lambda: not here.is_sounding())
        begin, player = here.position, soft_amp.player
        _wait_for_samples(here, 0.5)
        assert not here.samples(here.position - begin).any()
        assert all(here.is_played_to(f"zeros:in_{n}") for n in (1, 2))
        assert soft_amp.player == player

    await silent(None)
    await silent(lambda amplifier: amplifier.stop())
    await silent(lambda amplifier: amplifier.disarm())
    soft_amp.end()
    assert "soft-amp: 0 gaps" in soft_amp.log
    here.close()


@pytest.mark.real_time
@pytest.mark.needs("jackd", "cc")
@pytest.mark.parametrize(
    ("changed", "key"),
    [
        ({"channels": PLAYED_CHANNELS + 1}, "--device"),
        ({"rate": 96_000}, "--rate"),
        ({"block": 2 * CARD_BLOCK}, "--block"),
        ({"device": "jack:nothing"}, "--device"),
        ({"device": "jack:crad"}, "did you mean jack:card"),
    ],
)
def test_unsuitable_device_is_refused(
    sound: tuple[Capture, dict[str, str]],
    monkeypatch: pytest.MonkeyPatch,
    changed: dict[str, object],
    key: str,
) -> None:
    """By the option at fault; a client that was mistyped by the one that was meant."""
    monkeypatch.setenv("JACK_DEFAULT_SERVER", sound[1]["JACK_DEFAULT_SERVER"])
    with pytest.raises(InputError, match=key):
        open_output(replace(SETTINGS, **changed))


@pytest.mark.real_time
@pytest.mark.needs("jackd", "cc")
@pytest.mark.needs("portaudio")
@pytest.mark.parametrize("line", shortly(["--tcp", "--modbus-tcp"], ["--tcp"]))
def test_all_of_it_killed_is_silent(
    sound: tuple[Capture, dict[str, str]], tmp_path: Path, line: str
) -> None:
    """The process that plays dies with the one that watches it; here through PortAudio."""
    capture = capture_on(sound[1]["JACK_DEFAULT_SERVER"], "other", 2)
    options = ("--device", "other", "--channels", "2", line, "0", "--law", "square")
    # PortAudio leaves samples out where the machine stalls.
    soft_amp = SoftAmp(*options, "--max-gaps", "63", environment=sound[1], log=tmp_path / "log")
    with host(soft_amp.url, 2):
        wait_for(capture.is_sounding)
        player = Path(f"/proc/{soft_amp.player}")
        _wait_for_samples(capture, 1.2)  # 0.2 s of soft start and ramp
        forces = 2 * capture.samples(CARD_RATE) ** 2 - 1  # u = sqrt((1 + force) / 2)
        windows = forces.reshape(20, CARD_RATE // 20, 2)
        levels = np.abs(np.fft.rfft(windows, axis=1)[:, 1000 // 20]) / (CARD_RATE // 40)
        np.testing.assert_allclose(np.median(levels, axis=0), 0.5, rtol=0.011)
        soft_amp.process.kill()
        killed = capture.position
        wait_for(lambda: not player.exists())
        assert capture.end_of_sound() - killed < CARD_RATE * SILENCE
    soft_amp.end()
    capture.close()


def _wait_for_samples(capture: Capture, seconds: float) -> None:
    end = capture.position + CARD_RATE * seconds
    wait_for(lambda: capture.position > end)

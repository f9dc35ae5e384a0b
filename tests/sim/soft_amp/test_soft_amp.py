"""The software amplifier: its settings, its clock, and its samples at a sound server.

What it rejects before any device is opened; the clock while PortAudio states when a block is
played; and samples through PortAudio's JACK host API, as another client of a real JACK server
records them.
"""

import ctypes
import json
import multiprocessing
import os
import signal
import socket
import struct
import subprocess
from collections.abc import Awaitable, Callable, Iterator
from contextlib import suppress
from multiprocessing.connection import Connection
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from cobs import cobs

from cases import shortly
from drivers.errors import LinkError
from drivers.host.amplifier import Amplifier
from drivers.opening import Lines
from drivers.protocol.definition import STATES
from kit import hand_frames as hand
from model.arrays import ComplexArray, Float32Array
from model.errors import InputError
from processes.daemons import PATIENCE
from processes.gateways import wait_for
from processes.installed import ERA
from processes.jack_recorder import Capture
from processes.sound_cards import BLOCK as CARD_BLOCK
from processes.sound_cards import RATE as CARD_RATE
from processes.sound_cards import SoftAmp, jack_server
from sim.soft_amp.engine import Counters, library, start_engine
from sim.soft_amp.output import may_be_realtime, portaudio_device, portaudio_stream
from sim.soft_amp.settings import (
    Law,
    Protocol,
    SoftAmplifierLine,
    SoftAmplifierSettings,
    terminal_place,
)
from tests.sim.soft_amp.steady_host import WATCHDOG, linear_amplifier, playing_host

CHANNELS = 2
RATE = 96_000  # not the usual one


@pytest.mark.real_time
@pytest.mark.needs("jackd", "portaudio")
def test_devices_are_listed_with_outputs_inputs_rate_and_block() -> None:
    """Of a server with 4 outputs and 3 inputs and of a client; JACK is missing without a server."""
    name = f"list{os.getpid()}"
    with jack_server(name, rate=RATE, inputs=3, outputs=4) as server:
        capture = Capture(name, "card", CHANNELS)
        devices = _listed(server.environment)["devices"]
        capture.close()
    by_name = {device["name"]: device for device in devices}
    common = {"host": "JACK Audio Connection Kit", "rate_hz": RATE, "block_frames": None}
    ports = {"system": (4, 3), "card": (CHANNELS, 0)}
    for device, (outputs, inputs) in ports.items():
        number = by_name[device].pop("device")
        assert int(number) >= 0
        expected = {"name": device, "outputs": outputs, "inputs": inputs}
        assert by_name[device] == common | expected
    without = _listed(os.environ | {"JACK_DEFAULT_SERVER": f"none{os.getpid()}"})
    assert "start jackd" in without["missing"][-1]["reason"]


def _listed(environment: dict[str, str]) -> dict[str, list[dict[str, object]]]:
    done = subprocess.run(
        [ERA, "soft-amp", "--list", "--json"], capture_output=True, env=environment, check=True
    )
    return json.loads(done.stdout)  # type: ignore[no-any-return]


CLOCK_RATE, BLOCK = 48_000, 128
TURN = 20.0  # s
TOLERANCE = 2e-8  # s; four steps of the clock


class PortAudioTime(ctypes.Structure):
    """PaStreamCallbackTimeInfo of portaudio.h."""

    _fields_ = (("input", ctypes.c_double), ("now", ctypes.c_double), ("output", ctypes.c_double))


class CallingPortAudio:
    """Calls the engine for one block after the other, at stated times.

    latency [s]: from the call until the block's first sample is played; frame: of that sample.
    """

    def __init__(self) -> None:
        self.frame, self.latency = 0, 0.0
        self._samples = (ctypes.c_float * (2 * BLOCK))()

    def call(self) -> None:
        """Ask for a block."""
        output = self.frame / CLOCK_RATE
        times = PortAudioTime(0.0, output - self.latency, output)
        library().sound_portaudio(
            None, self._samples, ctypes.c_ulong(BLOCK), ctypes.byref(times), ctypes.c_ulong(0), None
        )
        self.frame += BLOCK


def play(results: Connection) -> None:
    """Send what clocks [s] an engine shows, less the time when the block before is played.

    At first; then with a latency; then behind a gap of 480 frames.
    """
    caller, counters = CallingPortAudio(), Counters()
    host, terminal = socket.socketpair()
    terminal.setblocking(False)
    place = SoftAmplifierLine("serial:///x", terminal=terminal.fileno())
    start_engine(settings(channels=2), place, rate=CLOCK_RATE, counters=counters)

    def run(served: int) -> int:
        """Ask for blocks until so many requests were served; return the last block's frame."""
        since = caller.frame
        while counters.requests < served:
            since = caller.frame
            caller.call()
        return since

    def clock() -> float:
        host.sendall(hand.frame(hand.GET_STATUS, sequence=1))
        since = run(counters.requests + 1)
        data = b""
        while data.count(b"\0") < 2:
            data += host.recv(300)
        words = struct.unpack_from("<9H", cobs.decode(data.strip(b"\0")), 5)
        return float((words[7] << 16 | words[8]) / 2**32 * TURN - since / CLOCK_RATE)

    run(1)  # the host is there
    readings = [clock()]
    caller.latency = 384 / CLOCK_RATE
    readings.append(clock())
    caller.frame += 480
    readings.append(clock())
    library().sound_release()
    results.send(readings)


@pytest.mark.needs("cc")
def test_clock_is_the_time_of_the_output() -> None:
    """It lags the samples by PortAudio's latency, and advances by lost samples.

    The engine is in a process of its own, since its threads have no end.
    """
    library()
    forked = multiprocessing.get_context("fork")
    results, theirs = forked.Pipe(duplex=False)
    process = forked.Process(target=play, args=(theirs,), daemon=True)
    process.start()
    try:
        assert results.poll(60)
        first, *later_results = results.recv()
    finally:
        process.kill()
        process.join()
    for reading in later_results:
        assert (first - reading) % TURN == pytest.approx(384 / CLOCK_RATE, abs=TOLERANCE)


def settings(**changed: object) -> SoftAmplifierSettings:
    """Settings of four channels, changed."""
    values: dict[str, object] = {
        "device": "card",
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
    """The error names the option; the square law leaves no force below a limit of 0.707."""
    with pytest.raises(InputError, match=key):
        settings(**changed)


def test_more_than_16_channels_are_two_amplifiers() -> None:
    """At addresses 1 and 2 of a serial line, units 1 and 2 of Modbus."""
    square_law = settings(channels=18, law=Law.SQUARE, limit=0.9)
    assert SoftAmplifierLine("serial:///x").urls(
        square_law.amplifiers, protocol=Protocol.SERIAL
    ) == [
        "serial:///x",
        "serial:///x?address=2",
    ]
    urls = SoftAmplifierLine("modbus+tcp://h:1").urls(
        square_law.amplifiers, protocol=Protocol.MODBUS
    )
    assert urls == ["modbus+tcp://h:1/1", "modbus+tcp://h:1/2"]


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


@pytest.mark.parametrize(
    ("device", "names", "problem", "cause"),
    [
        ("Scarlet 4i4", [], LinkError, "connect a sound card"),
        ("Scarlet 4i4", ["Scarlett 4i4"], InputError, "did you mean Scarlett 4i4"),
        ("jack", ["HDA Intel"], InputError, '"system, JACK"'),
        ("jack:desk", ["HDA Intel"], InputError, '"CLIENT, JACK"'),
    ],
)
def test_unknown_device_is_rejected_with_a_remedy(
    device: str,
    names: list[str],
    problem: type[Exception],
    cause: str,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Connect a device, correct the name, or select JACK in the stated way."""

    def query(number: object = None, _kind: object = None) -> object:
        if number is None:
            return [{"name": name} for name in names]
        raise ValueError(f"No output device matching {number!r}")

    library = SimpleNamespace(query_devices=query, PortAudioError=OSError)
    monkeypatch.setattr("sim.soft_amp.output.sounddevice", lambda: library)
    with pytest.raises(problem, match=cause):
        portaudio_device(device, outputs=2)


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
    """Otherwise its device would stay in use until the program ends."""
    library = SimpleNamespace(_StreamBase=_Busy, _ffi=SimpleNamespace(cast=lambda *_: None))
    monkeypatch.setattr("sim.soft_amp.output.sounddevice", lambda: library)
    with pytest.raises(OSError, match="unavailable"):
        portaudio_stream(0, 0, 0, outputs=2)
    assert _Busy.is_closed


CARD_CHANNELS = 3
SILENCE_AFTER_KILL, SILENCE_AFTER_STALL = (0.1, 0.25) if may_be_realtime() else (2.0, 2.1)
"""s; the page promises the first two, with real-time priority."""


def amplitudes(samples: Float32Array, rate: int) -> ComplexArray:
    """Complex amplitudes (windows, channels) of 1 kHz in 50 ms each of samples (n, channels)."""
    windows = samples.reshape(-1, rate // 20, samples.shape[1])
    turning = np.exp(-2j * np.pi * 1000 * np.arange(rate // 20) / rate)
    return np.asarray(2 * (windows * turning[:, None]).mean(axis=1))


@pytest.fixture(scope="module")
def server() -> Iterator[str]:
    """The name of a server whose outputs are monitored."""
    name = f"era{os.getpid()}"
    with jack_server(name, outputs=CARD_CHANNELS, is_monitored=True):
        yield name


@pytest.fixture(scope="module")
def card(server: str) -> Iterator[Capture]:
    """Return the samples that the server sends to its sound card."""
    capture = Capture(server, "recorder", CARD_CHANNELS, is_card=True)
    yield capture
    capture.close()


def amplifier_on(
    device: str,
    channels: int,
    server: str,
    folder: Path,
    *options: str,
    notify: str = "",
    is_watched: bool = False,
) -> SoftAmp:
    """An amplifier on a device of a server; notify: the socket of a service manager.

    is_watched: whether a stall ends it, which this machine may cause as well as a test.
    """
    environment = os.environ | {"JACK_DEFAULT_SERVER": server}
    if notify:
        environment |= {"NOTIFY_SOCKET": notify, "WATCHDOG_USEC": "500000"}
    where = options or ("--link", str(folder / "amp"))
    amplifier = SoftAmp(
        *("--device", device, "--channels", str(channels), "--max-gaps", "63", *where),
        environment=environment,
        log=folder / "log",
        is_watched=is_watched,
    )
    STARTED.append(amplifier.process)
    return amplifier


STARTED: list["subprocess.Popen[str]"] = []


@pytest.fixture(autouse=True)
def no_amplifier_left() -> Iterator[None]:
    """After a test that failed its amplifiers are killed, for they have real-time priority."""
    yield
    while STARTED:
        STARTED.pop().kill()


@pytest.mark.real_time
@pytest.mark.needs("jackd", "portaudio", "cc")
def test_samples_arrive_at_jack_as_commanded(tmp_path: Path) -> None:
    """Level x sin(2 pi f t + phase) within 0.1 dB, and within 0.1 degrees between channels.

    By hand: 1 kHz at level 0.5 has the amplitude 0.5 there, at the server's rate, and each channel
    leads the previous one by 30 degrees. Phases turn by less than 0.1 degrees in 50 ms, so
    that the frequency is right within 6 mHz. Medians, since a busy machine leaves samples out.
    Silence once the host is lost.
    """
    name = f"play{os.getpid()}"
    with jack_server(name, rate=RATE):
        capture = Capture(name, "card", CARD_CHANNELS)
        amp = amplifier_on("card, JACK", CARD_CHANNELS, name, tmp_path)
        assert f"{RATE} Hz, blocks of {CARD_BLOCK} frames" in amp.log
        with playing_host(amp.url, CARD_CHANNELS) as playing:
            wait_for(lambda: capture.has_sounded_for(2.3))  # 0.2 s of soft start and ramp
            amplitude_of = amplitudes(capture.samples(2 * RATE), RATE)
            sizes = np.median(np.abs(amplitude_of), axis=0)
            steps = np.median(np.angle(amplitude_of[:, 1:] / amplitude_of[:, :-1]), axis=0)
            turns = np.median(np.angle(amplitude_of[1:] / amplitude_of[:-1]), axis=0)
            np.testing.assert_allclose(20 * np.log10(sizes / 0.5), 0, atol=0.1)
            np.testing.assert_allclose(np.degrees(steps), 30, atol=0.1)
            np.testing.assert_allclose(np.degrees(turns), 0, atol=0.1)
            playing.kill()
            killed = capture.position
            wait_for(lambda: not capture.is_sounding())
            assert capture.end_of_sound() - killed < RATE * (WATCHDOG + 0.05)
        amp.end()
        capture.close()


@pytest.mark.real_time
@pytest.mark.needs("jackd", "portaudio", "cc")
@pytest.mark.usefixtures("unhurried")
@pytest.mark.parametrize(
    ("how", "limit"),
    [(signal.SIGKILL, SILENCE_AFTER_KILL), (signal.SIGSTOP, SILENCE_AFTER_STALL)],
)
async def test_killed_or_stopped_amplifier_is_silent_and_restarts_disarmed(
    server: str, card: Capture, tmp_path: Path, how: signal.Signals, limit: float
) -> None:
    """No sound is left at the card within the time of the page: a stopped one is killed, too.

    The next one takes its link over, plays zeros and is not armed.
    """
    is_watched = how is signal.SIGSTOP
    amp = amplifier_on("system, JACK", CARD_CHANNELS, server, tmp_path, is_watched=is_watched)
    with playing_host(amp.url, CARD_CHANNELS):
        wait_for(card.is_sounding)
        position = card.position
        os.kill(amp.process.pid, how)
        assert amp.process.wait(60) == -signal.SIGKILL
        wait_for(lambda: not card.is_sounding())
        assert card.end_of_sound() - position < CARD_RATE * limit
    amp.end()
    following = amplifier_on("system, JACK", CARD_CHANNELS, server, tmp_path)
    assert following.url == amp.url
    lines = Lines()
    amplifier = await linear_amplifier(lines, following.url)
    await amplifier.open()
    assert (await amplifier.read_status())["state"] == STATES["SWITCH_ON_DISABLED"]
    await lines.close()
    assert not card.is_sounding()
    following.end()


@pytest.mark.real_time
@pytest.mark.needs("jackd", "portaudio", "cc")
def test_systemd_is_notified_of_sound_and_not_during_a_stall(server: str, tmp_path: Path) -> None:
    """READY=1 after the first block, then WATCHDOG=1 until the process is stopped; then nothing.

    The socket is that of sd_notify(3).
    """
    address = str(tmp_path / "notify")
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as manager:
        manager.bind(address)
        manager.settimeout(PATIENCE)
        amp = amplifier_on(
            "system, JACK", CARD_CHANNELS, server, tmp_path, notify=address, is_watched=True
        )
        ready, status, pid = manager.recv(4096).decode().splitlines()
        assert (ready, pid) == ("READY=1", f"MAINPID={amp.process.pid}")
        assert "system, 3 channels" in status
        assert [manager.recv(4096) for _ in range(4)] == [b"WATCHDOG=1"] * 4
        os.kill(amp.process.pid, signal.SIGSTOP)
        amp.process.wait(60)
        manager.settimeout(0)
        waiting = []
        with suppress(BlockingIOError):
            while True:
                waiting.append(manager.recv(4096))
        assert len(waiting) <= 1  # sent before the stop
    amp.end()


@pytest.mark.real_time
@pytest.mark.needs("jackd", "portaudio", "cc")
@pytest.mark.usefixtures("unhurried")
async def test_silence_is_an_open_output_of_zeros(server: str, tmp_path: Path) -> None:
    """After a lost host, a stop and a disarm: connected, and every sample exactly zero."""
    capture = Capture(server, "zeros", 2)
    soft_amp = amplifier_on("zeros, JACK", 2, server, tmp_path)
    lines = Lines()

    async def silent(end: Callable[[Amplifier], Awaitable[object]] | None) -> None:
        with playing_host(soft_amp.url, 2) as playing:
            wait_for(capture.is_sounding)
            playing.kill()
            playing.wait()
        if end is not None:
            amplifier = await linear_amplifier(lines, soft_amp.url)
            await amplifier.open()
            await end(amplifier)
            await lines.close()
        wait_for(lambda: not capture.is_sounding())
        begin = capture.position
        _wait_for_samples(capture, 0.5)
        assert not capture.samples(capture.position - begin).any()
        assert capture.is_played_to("zeros:in_1")
        assert capture.is_played_to("zeros:in_2")

    await silent(None)
    await silent(lambda amplifier: amplifier.stop())
    await silent(lambda amplifier: amplifier.disarm())
    soft_amp.end()
    assert soft_amp.process.returncode == 0
    capture.close()


@pytest.mark.real_time
@pytest.mark.needs("jackd", "portaudio", "cc")
@pytest.mark.parametrize("line", shortly(["--tcp", "--modbus-tcp"], ["--tcp"]))
def test_square_law_plays_the_root_of_a_bias_and_the_force(
    server: str, tmp_path: Path, line: str
) -> None:
    """u = sqrt((1 + force) / 2), so that 2 u² - 1 has the amplitude 0.5 of the force; over TCP."""
    capture = Capture(server, "other", 2)
    soft_amp = amplifier_on("other, JACK", 2, server, tmp_path, line, "0", "--law", "square")
    with playing_host(soft_amp.url, 2):
        wait_for(lambda: capture.has_sounded_for(1.3))  # 0.2 s of soft start and ramp
        forces = 2 * capture.samples(CARD_RATE) ** 2 - 1
        windows = forces.reshape(20, CARD_RATE // 20, 2)
        levels = np.abs(np.fft.rfft(windows, axis=1)[:, 1000 // 20]) / (CARD_RATE // 40)
        np.testing.assert_allclose(np.median(levels, axis=0), 0.5, rtol=0.011)
    soft_amp.end()
    capture.close()


@pytest.mark.real_time
@pytest.mark.needs("jackd", "portaudio", "cc")
def test_lost_server_ends_the_amplifier(tmp_path: Path) -> None:
    """One message and exit status 3, so that a service manager restarts it."""
    name = f"lost{os.getpid()}"
    with jack_server(name) as running:
        Capture(name, "looking", 1).close()  # once the server is up
        amp = amplifier_on("system, JACK", 2, name, tmp_path)
        earlier_log = amp.log
        running.process.terminate()
        assert amp.process.wait(60) == 3
        message = amp.log.removeprefix(earlier_log)
        assert (message.count("\n"), "device was lost" in message) == (1, True)
    amp.end()


@pytest.mark.real_time
@pytest.mark.needs("jackd", "portaudio", "cc")
@pytest.mark.parametrize(
    ("options", "key"),
    [
        (("--channels", "4", "--device", "system, JACK"), "must have 4 outputs, got 3"),
        (("--channels", "2", "--device", "system, JACK", "--rate", "96000"), "--rate"),
        (("--channels", "2", "--device", "jack:nothing"), '"system, JACK"'),
        (("--channels", "2", "--device", "sytem"), "did you mean system"),
    ],
)
def test_unsuitable_device_is_rejected(server: str, options: tuple[str, ...], key: str) -> None:
    """One message that names the option at fault; exit status 2."""
    Capture(server, "looking", 1).close()  # once the server is up
    done = subprocess.run(
        [ERA, "soft-amp", *options],
        stdin=subprocess.DEVNULL,
        capture_output=True,
        text=True,
        env=os.environ | {"JACK_DEFAULT_SERVER": server},
        timeout=60,
        check=False,
    )
    assert (done.returncode, done.stdout) == (2, "")
    assert done.stderr.count("\n") == 1
    assert key in done.stderr


def _wait_for_samples(capture: Capture, seconds: float) -> None:
    end = capture.position + capture.rate * seconds
    wait_for(lambda: capture.position > end)

"""Playback of layers against curves that the protocol gives by hand, its bounds, and ports.

The bounds of what plays contain every amplifier that committed within the intervals; a port is
opened, written without waiting, and lost.
"""

import asyncio
import contextlib
import errno
import math
import os
import pty
import random
import socket
import subprocess
import sys
import termios
import tty
from collections.abc import AsyncIterator, Iterator, Mapping, Sequence
from contextlib import asynccontextmanager
from dataclasses import dataclass
from itertools import product
from pathlib import Path
from typing import Any
from unittest.mock import Mock

import pytest
import serial

from drivers import ports
from drivers.errors import LinkError, LinkTimeout
from drivers.playing import Playback
from drivers.ports import Port, SerialPort, open_connection
from drivers.protocol.sets import Command, Envelope, LayerSet
from drivers.urls import Endpoint
from drivers.voices import Voice, along
from era_haptics.lab.expectations.expected_outputs import ExpectedOutputs
from era_haptics.lab.expectations.tolerances import Interval
from era_haptics.lab.expectations.uncertain_playback import UncertainPlayback
from kit.clock import in_virtual_time
from kit.courses import Taken, courses, follow


def test_slope_counts_the_whole_onset_before_it_starts() -> None:
    """By hand: from 0 to 0.4 in 4 ms, then flat for 16 ms: 100 full levels/s are still to come."""
    onset = Envelope(40, ((4000, 0),) * 4)
    transition = along(onset, 1.0, 0.0, 0j, 0.4 + 0j)
    for time in (0.9, 0.994, 1.0, 1.003):
        assert transition.slope(time) == pytest.approx(100.0)
    assert transition.slope(1.005) == 0.0


@pytest.mark.parametrize(("valid_for", "end"), [(1000, 1.4), (0, 0.008)])
def test_layer_at_level_zero_is_silent_once_its_ending_is_over(valid_for: int, end: float) -> None:
    """By hand: after 1 s its ending takes four steps of 0.1 s; without end, an onset takes 8 ms."""
    onset = Envelope(40, ((5000, 0),))
    ending = Envelope(1000, ((8000, 0),) * 3)
    playback = Playback(1, 8)
    tone = Command(0, 4000, 0, 0, onset=onset, ending=ending)
    playback.commit([LayerSet(0, 0, valid_for, (tone,))], 1, 0.0)
    assert playback.ends_by == pytest.approx(end)


@pytest.mark.parametrize(
    ("device", "parity"), [("/dev/ttyUSB9", serial.PARITY_ODD), ("/dev/pts/9", serial.PARITY_NONE)]
)
def test_device_is_opened_alone_with_low_latency_and_its_settings(
    monkeypatch: pytest.MonkeyPatch, device: str, parity: str
) -> None:
    """A pseudo-terminal has no parity. DTR stays up afterwards: it restarts boards."""
    far, near = os.openpty()
    made = Mock()
    made.return_value.fileno.return_value = near
    monkeypatch.setattr(ports.serial, "Serial", made)
    ports.open_device(Endpoint(device, baud=19_200, parity="O", stop=2))
    made.return_value.set_low_latency_mode.assert_called_once_with(True)
    settings = {key: made.call_args.kwargs[key] for key in ("baudrate", "parity", "stopbits")}
    assert settings == {"baudrate": 19_200, "parity": parity, "stopbits": 2}
    assert made.call_args.kwargs["exclusive"]
    assert not termios.tcgetattr(near)[2] & termios.HUPCL
    os.close(near)
    os.close(far)


async def test_port_that_fails_amid_its_opening_is_released(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """It is opened exclusively: else this program could not open it again."""
    far, near = os.openpty()
    name = os.ttyname(near)

    async def open_it() -> Port:
        return await ports.open_port(
            Endpoint(name, baud=9600), lambda data: None, lambda cause: None
        )

    def fail(port: serial.Serial) -> None:
        raise OSError(errno.EIO, "gone")

    with monkeypatch.context() as patch:
        patch.setattr(serial.Serial, "reset_input_buffer", fail)
        with pytest.raises(LinkError, match="gone"):
            await open_it()
    port = await open_it()
    port.close()
    await port.wait_closed()
    os.close(near)
    os.close(far)


@pytest.fixture
def ends() -> Iterator[tuple[serial.Serial, int]]:
    """A port, and the descriptor at its other end."""
    far, near = pty.openpty()
    tty.setraw(near)
    port = serial.Serial(os.ttyname(near), timeout=0)
    yield port, far
    port.close()
    os.close(near)
    os.close(far)


async def test_blocked_port_takes_the_newest_frame(ends: tuple[serial.Serial, int]) -> None:
    """Unsent bytes of an older one are dropped; the newest follows without another call."""
    port, far = ends
    watched, got = SerialPort(port, "/dev/ttyUSB9", lambda data: None, lambda what: None), b""
    watched.write(b"a" * (1 << 20))
    assert watched.is_blocked
    watched.write(b"b" * (1 << 20))
    watched.write(b"stop")
    os.set_blocking(far, False)
    async with asyncio.timeout(60.0):
        while not got.endswith(b"stop"):
            with contextlib.suppress(BlockingIOError):
                got += os.read(far, 1 << 16)
            await asyncio.sleep(0)
    assert got.count(b"b") < 1 << 20
    assert got.count(b"a") < 1 << 20
    assert not watched.is_blocked
    watched.close()
    await watched.wait_closed()


async def test_closed_port_is_a_link_error(ends: tuple[serial.Serial, int]) -> None:
    """And the loss is reported once."""
    port, far = ends
    losses: list[str] = []
    watched = SerialPort(port, "/dev/ttyUSB9", lambda data: None, losses.append)
    watched.write(b"a" * (1 << 20))
    os.close(os.dup(far))
    os.dup2(os.open(os.devnull, os.O_RDWR), far)  # hangs up
    with pytest.raises(LinkError, match="check the cable"):
        watched.write(b"stop")
    assert len(losses) == 1
    watched.close()
    await watched.wait_closed()


async def test_error_of_whoever_takes_the_data_is_no_loss(ends: tuple[serial.Serial, int]) -> None:
    """A LinkError is an OSError, as those of a port that is gone."""
    port, far = ends
    fail, lost = Mock(side_effect=LinkError("of another line")), Mock()
    watched = SerialPort(port, "/dev/ttyUSB9", fail, lost)
    os.write(far, b"reply")
    with pytest.raises(LinkError, match="of another line"):
        watched.poll()
    lost.assert_not_called()
    watched.close()
    await watched.wait_closed()


@pytest.fixture
def listening() -> Iterator[tuple[socket.socket, int]]:
    """A socket that listens, and its port."""
    with socket.create_server(("127.0.0.1", 0)) as server:
        yield server, server.getsockname()[1]


async def connected(port: int) -> Port:
    """A connection to a port."""
    return await open_connection("127.0.0.1", port, lambda _: None, lambda _: None)


async def test_connection_timeout_has_a_remedy(
    listening: tuple[socket.socket, int], monkeypatch: pytest.MonkeyPatch
) -> None:
    """The connection is neither accepted nor refused."""
    monkeypatch.setattr(ports, "CONNECT_TIMEOUT", 0.0)
    with pytest.raises(LinkError, match=rf"127.0.0.1:{listening[1]}: .*check the address"):
        await connected(listening[1])


@pytest.mark.parametrize("first", ["hangs", "refuses"])
@in_virtual_time
async def test_next_address_of_a_host_is_tried(first: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """After 250 ms (RFC 8305), or at once where the first refuses; that one then has no effect."""
    loop, accepts = asyncio.get_running_loop(), asyncio.Event()
    server = await loop.create_server(asyncio.Protocol, port=502)
    connect, losses = loop.create_connection, list[str]()

    async def connecting(make: Any, address: str, port: int) -> Any:
        if address == "fd00::1" and first == "refuses":
            raise ConnectionRefusedError
        if address == "fd00::1":
            await accepts.wait()
        return await connect(make, address, port)

    async def found(host: str) -> list[str]:
        return ["fd00::1", "192.0.2.1"]

    monkeypatch.setattr(loop, "create_connection", connecting)
    monkeypatch.setattr(ports, "host_addresses", found)
    began = loop.time()
    connection = await open_connection("amplifier.test", 502, lambda _: None, losses.append)
    assert loop.time() - began == pytest.approx(0.25 if first == "hangs" else 0.0, abs=0.01)
    accepts.set()
    await asyncio.sleep(1.0)
    assert losses == []
    connection.close()
    server.close()


async def test_connection_gives_up_what_is_not_taken(
    listening: tuple[socket.socket, int],
) -> None:
    """Within a second (RFC 5482): the kernel's option, in milliseconds; frames are sent at once.

    What blocks is a timeout before memory fills; closing discards unsent data.
    """
    connection = await connected(listening[1])
    endpoint = connection._transport.get_extra_info("socket")  # type: ignore[attr-defined]
    options = (socket.TCP_USER_TIMEOUT, socket.TCP_NODELAY)
    assert [endpoint.getsockopt(socket.IPPROTO_TCP, each) for each in options] == [1000, 1]
    connection.write(bytes(64 << 20))
    with pytest.raises(LinkTimeout, match="check the network"):
        connection.write(b"x")
    connection.close()
    await connection.wait_closed()
    await asyncio.sleep(0)  # the transport reports the end


async def test_link_local_address_keeps_its_zone(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """RFC 4007."""
    of_name = ("fe80::1", 0, 0, 4000), ("fd00::1", 0, 0, 0), ("192.0.2.1", 0)
    found = [(0, 0, 0, "", address) for address in of_name]
    monkeypatch.setattr(ports.socket, "getaddrinfo", lambda *args, **kwargs: found)
    assert await ports.host_addresses("amplifier.test") == ["fe80::1%4000", "fd00::1", "192.0.2.1"]


def test_unresolved_name_does_not_delay_the_end_of_the_program() -> None:
    """Even if the name server does not reply."""
    program = """
import asyncio, socket, threading
from drivers import ports
from drivers.errors import LinkError

socket.getaddrinfo = lambda *args, **kwargs: threading.Event().wait()
ports.CONNECT_TIMEOUT = 0.05
try:
    asyncio.run(ports.open_connection("amplifier.test", 502, lambda _: None, lambda _: None))
except LinkError as problem:
    print(problem)
"""
    ran = subprocess.run(
        [sys.executable, "-c", program], check=True, timeout=60, capture_output=True, text=True
    )
    assert "amplifier.test:502: no connection" in ran.stdout


def layer_of(
    number: int = 0,
    *,
    ramp: int = 0,
    valid_for: int = 0,
    tones: Sequence[Mapping[str, Any]] = (),
    after: bool = False,
) -> LayerSet:
    """A layer of rows of tones, with the step [0.1 ms] and knots of each onset and ending."""
    commands = []
    for tone in tones:
        shapes = {name: tone[name] for name in ("onset", "ending") if name in tone}
        made = {
            name: Envelope(step, tuple(map(tuple, knots)))
            for name, (step, *knots) in shapes.items()
        }
        commands.append(Command(**{"channel": 0, "phase": 0, **tone, **made}))
    return LayerSet(number, ramp, valid_for, tuple(commands), after)


@dataclass(kw_only=True)
class OfLayers(Taken):
    """What plays, the bounds of what may play, and what is expected of outputs silent at 0 s.

    found: the rules that are reported to be broken.
    """

    playback: Playback
    bounds: UncertainPlayback
    outputs: ExpectedOutputs
    report: Mock
    found: list[str]

    def commits(self, token: int, at: float, **layer: Any) -> None:
        """Let a layer play at a moment."""
        self.playback.commit([layer_of(**layer)], token, at)

    def may_commit(self, token: int, since: float, until: float, **layer: Any) -> None:
        """Let a layer play at some moment within."""
        self.bounds.commit([layer_of(**layer)], token, Interval(since, until))

    def expects(self, token: int, since: float, until: float, **layer: Any) -> None:
        """Let a layer be expected that began at some moment within."""
        self.outputs.play([layer_of(**layer)], token, Interval(since, until), is_exact=True)

    def silences(self, since: float, until: float, ramp: float, cause: str) -> None:
        """Let all layers be expected to fade from some moment within."""
        self.outputs.silence(Interval(since, until), ramp, cause)

    def sure_at(self, at: float) -> set[int]:
        """Return the layers whose output is known at a moment."""
        return self.outputs.sure(Interval(at, at))

    def shows(self, levels: Sequence[float], at: float) -> None:
        """Let the outputs show levels at a moment."""
        self.outputs.check_levels(levels, Interval(at, at), self.report)

    def is_ambiguous(self, expected: bool, since: float, until: float, **layer: Any) -> None:
        """Require that it is unknown, or not, what a layer would play that comes within."""
        assert self.bounds.is_ambiguous(Interval(since, until), [layer_of(**layer)]) is expected


@asynccontextmanager
async def of_layers() -> AsyncIterator[OfLayers]:
    """Two channels, of eight voices each."""
    found: list[str] = []
    report = Mock(side_effect=lambda rule, *_, **__: found.append(rule))
    how = {"unclear": None, "slack": 0.0, "cause": "", "began": Interval(0.0, 0.0)}
    yield OfLayers(
        playback=Playback(2, 8),
        bounds=UncertainPlayback(Playback(2, 8)),
        outputs=ExpectedOutputs({}, report=report, **how),
        report=report,
        found=found,
    )


COURSES = courses(Path(__file__).with_name("playing.yaml"))


@pytest.mark.parametrize("name", COURSES)
def test_layers_keep_to_their_course(name: str) -> None:
    """Every step is as it is in the file, by hand."""
    follow(COURSES[name], of_layers)


def test_random_sets_never_jump_and_keep_their_bounds() -> None:
    """Whatever is committed, amplitudes move no faster than slopes and stay below `peak`."""
    chance = random.Random(4)
    for _ in range(60):
        playback = Playback(1, 8)
        time, token = 0.0, 0
        for _ in range(12):
            time += chance.choice((0.0007, 0.004, 0.013, 0.03))
            if chance.random() < 0.1:
                playback.silence(time, chance.choice((0.005, 0.05)))
            else:
                token += 1
                playback.commit([random_layer(chance)], token, time)
            peak = sum(voice.transition.peak(time) for voice in playback.all_voices[0])
            slope = sum(voice.transition.slope(time) for voice in playback.all_voices[0])
            before = _field(playback.all_voices[0], time)
            for _ in range(12):
                later = time + chance.random() * 5e-4
                after = _field(playback.all_voices[0], later)
                assert playback.level(0, later) <= peak + 1e-9
                assert abs(after - before) <= slope * (later - time) + 1e-9


def _field(voices: tuple[Voice, ...], time: float) -> complex:
    """The sum of all amplitudes, as if their tones stood still."""
    return sum((voice.transition.at(time) for voice in voices), 0j)


def test_fade_that_is_cut_short_is_as_fast_as_the_amplifier_can() -> None:
    """A raised cosine from 1 is steepest at pi/2 over its length: 157 ms at 10 full levels/s."""
    for slew, length in ((math.inf, 0.002), (10.0, math.pi / 20)):
        playback = Playback(1, 8, slew)
        playback.commit([LayerSet(0, 20, 0, (Command(0, 2000, 10_000, 0),))], 1, 0.0)
        for n in range(9):
            played = LayerSet(0, 1000, 0, (Command(0, 3000 + n, 5000, 0),))
            playback.commit([played], 2 + n, 1.0 + 1e-6 * n)
        first = playback.all_voices[0][0].transition
        assert first.end - first.start == pytest.approx(length, rel=1e-3)


CHANNELS, LAYERS = 2, 3
AMPLIFIERS = 12  # of each course


def random_envelope(chance: random.Random) -> Envelope | None:
    """None, or up to three knots."""
    if chance.random() < 0.6:
        return None
    knots = [
        (chance.randrange(3000), chance.randrange(-9000, 9000)) for _ in range(chance.randrange(4))
    ]
    return Envelope(chance.choice((50, 200, 500)), tuple(knots))


def random_layer(chance: random.Random) -> LayerSet:
    """What a layer may be sent: tones, silence, a renewal, or a set that waits."""
    number, ramp = chance.randrange(LAYERS), chance.choice((0, 5, 40, 120))
    valid_for = chance.choice((0, 0, 30, 90))
    kind = chance.random()
    if kind < 0.15:
        return LayerSet(number, 0, valid_for, (), False, True)
    commands = tuple(
        Command(
            channel,
            chance.choice((400, 2200)),
            chance.choice((0, 1500, 3000)),
            chance.randrange(-18000, 18000, 500),
            chance.random() < 0.4,
            chance.random() < 0.2,
            random_envelope(chance),
            random_envelope(chance),
        )
        for channel in range(CHANNELS)
        if chance.random() < 0.8
    )
    return LayerSet(number, ramp, valid_for, commands, bool(commands) and kind > 0.85, False)


@pytest.mark.parametrize("seed", [*range(40), 68, 508, 771, 1284])
def test_bounds_contain_every_amplifier(seed: int) -> None:
    """Whenever within its interval each carried each set out, early, late, or in between."""
    chance = random.Random(seed)
    bounds = UncertainPlayback(Playback(CHANNELS, 64))
    amplifiers = [Playback(CHANNELS, 64) for _ in range(AMPLIFIERS)]
    now, last_token = 0.0, 0
    for _ in range(8):
        begin = now + chance.choice((0.0, 0.001, 0.02, 0.1))
        end = begin + chance.choice((0.0, 0.002, 0.01))
        moments = [
            chance.choice((begin, end, chance.uniform(begin, end))) for _ in range(AMPLIFIERS)
        ]
        one = random_layer(chance)
        layers, ramp = (None if chance.random() < 0.1 else [one]), chance.choice((0.0, 0.03))
        if bounds.is_ambiguous(Interval(begin, end), layers, ramp):
            continue
        last_token += 1
        if layers is None:
            bounds.silence(Interval(begin, end), ramp)
        else:
            bounds.commit(layers, last_token, Interval(begin, end))
        for each, moment in zip(amplifiers, moments, strict=True):
            if layers is None:
                each.silence(moment, ramp)
            else:
                each.commit(layers, last_token, moment)
        now = end
        for _ in range(3):
            begin = now + chance.choice((0.0, 0.004, 0.03))
            now = begin + chance.choice((0.0, 0.003))
            for each in amplifiers:
                moment = chance.uniform(begin, now)
                each.advance(moment)
                for channel, is_exact in product(range(CHANNELS), (True, False)):
                    low, high = bounds.bounds(channel, begin, now, is_exact=is_exact)
                    level = each.level(channel, moment)
                    assert low - 1e-9 <= level <= high + 1e-9, (channel, is_exact, moment)

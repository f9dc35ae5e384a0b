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
from collections.abc import Callable, Iterator
from dataclasses import replace
from itertools import product
from typing import Any
from unittest.mock import Mock

import pytest
import serial

from drivers import ports
from drivers.errors import LinkError, LinkTimeout
from drivers.playing import Playback, Voice
from drivers.ports import Port, SerialPort, open_connection
from drivers.protocol.sets import Command, Envelope, LayerSet
from drivers.urls import Endpoint
from era_haptics.lab.expected_output import ExpectedOutputs, UncertainPlayback
from virtual_lines import in_virtual_time


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
    ports._open_device(Endpoint(device, baud=19_200, parity="O", stop=2))
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
    monkeypatch.setattr(ports, "_CONNECT_TIMEOUT", 0.0)
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
    monkeypatch.setattr(ports, "_addresses", found)
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
    assert await ports._addresses("amplifier.test") == ["fe80::1%4000", "fd00::1", "192.0.2.1"]


def test_unresolved_name_does_not_delay_the_end_of_the_program() -> None:
    """Even if the name server does not reply."""
    program = """
import asyncio, socket, threading
from drivers import ports
from drivers.errors import LinkError

socket.getaddrinfo = lambda *args, **kwargs: threading.Event().wait()
ports._CONNECT_TIMEOUT = 0.05
try:
    asyncio.run(ports.open_connection("amplifier.test", 502, lambda _: None, lambda _: None))
except LinkError as problem:
    print(problem)
"""
    ran = subprocess.run(
        [sys.executable, "-c", program], check=True, timeout=60, capture_output=True, text=True
    )
    assert "amplifier.test:502: no connection" in ran.stdout


def layer(number: int, *commands: Command, **other: int | bool) -> LayerSet:
    """A layer with a ramp of 20 ms that does not end."""
    return LayerSet(number, 20, int(other.pop("valid_for", 0)), commands, **other)  # type: ignore[arg-type]


def tone(channel: int = 0, frequency: int = 2000, level: int = 5000, **other: object) -> Command:
    """A tone of 100 Hz at half level unless told otherwise."""
    return Command(channel, frequency, level, 0, **other)  # type: ignore[arg-type]


def test_voice_that_has_faded_is_not_continued_however_seldom_time_advances() -> None:
    """Its onset to level 0 ended at 20 ms, before that of the channel for which a set waits."""
    playback = Playback(2, 8)
    short, long = Envelope(100, ((2000, 0),)), Envelope(200, ((2000, 0),))
    playback.commit([layer(0, tone(level=0, onset=short), tone(1, onset=long))], 1, 0.0)
    playback.commit([layer(0, tone(keep_phase=True), after=True)], 2, 0.01)
    playback.advance(1.0)
    assert [voice.began for voice in playback.all_voices[0]] == pytest.approx([0.04])


def test_tones_of_one_frequency_interfere_whenever_they_began() -> None:
    """By hand: 0.3, 0.4 i and -0.3 of 99.95 Hz add to 0.7 or less, however far apart they begin."""
    playback = Playback(1, 8)
    for number, (time, level, phase, sum_of_all) in enumerate(
        [(0.0, 3000, 0, 0.3), (1.2345, 4000, 9000, 0.5), (7.7777, 3000, 18000, 0.4)]
    ):
        one = Command(0, 1999, level, phase)
        playback.commit([LayerSet(number, 0, 0, (one,))], number + 1, time)
        assert playback.level(0, time) == pytest.approx(sum_of_all)
    other = Command(0, 2000, 1000, 0)
    playback.commit([LayerSet(3, 0, 0, (other,))], 4, 8.0)
    assert playback.level(0, 9.0) == pytest.approx(0.4 + 0.1)


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
        playback.commit([layer(0, tone(level=10_000))], 1, 0.0)
        for n in range(9):
            played = replace(layer(0, tone(frequency=3000 + n)), ramp=1000)
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
        if bounds.is_ambiguous((begin, end), layers, ramp):
            continue
        last_token += 1
        if layers is None:
            bounds.silence((begin, end), ramp)
        else:
            bounds.commit(layers, last_token, (begin, end))
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


def test_set_that_comes_as_another_layer_may_end_is_ambiguous() -> None:
    """By hand: what began within 0 to 60 ms and is valid for 100 ends within 100 to 160 ms."""
    bounds = UncertainPlayback(Playback(2, 8))
    first = LayerSet(0, 0, 100, (Command(0, 2200, 5000, 0),))
    bounds.commit([first], 1, (0.0, 0.06))
    other = LayerSet(1, 0, 0, (Command(1, 400, 5000, 0),))
    cases = (0.09, 0.099), (0.09, 0.101), (0.131, 0.133), (0.159, 0.17), (0.161, 0.17)
    found = [bounds.is_ambiguous(when, [other]) for when in cases]
    assert found == [False, True, True, True, False]
    bounds.commit([other], 2, (0.131, 0.133))  # for whoever cannot wait for another moment
    assert bounds.bounds(0, 0.134, 0.136) == pytest.approx((0.0, 0.5))
    assert bounds.bounds(0, 0.161, 0.162) == (0.0, 0.0)


def expecting() -> tuple[ExpectedOutputs, Callable[..., None], list[str]]:
    """What is expected of outputs that were silent at 0 s, what reports, and rules it reported."""
    found: list[str] = []
    report = Mock(side_effect=lambda rule, *_, **__: found.append(rule))
    outputs = ExpectedOutputs(
        {}, report=report, unclear=None, slack=0.0, cause="", began=(0.0, 0.0)
    )
    return outputs, report, found


def test_layer_may_have_ended_just_before_all_falls_silent() -> None:
    """By hand: it ends at once within 100 to 112 ms, and all fades for 50 ms from 110 ms on."""
    outputs, report, found = expecting()
    ended = Command(0, 2200, 5000, 0, ending=Envelope(10, ()))
    outputs.play([LayerSet(0, 0, 100, (ended,))], 1, (0.0, 0.01), is_exact=True)
    outputs.silence((0.11, 0.112), 0.05, "Disarm")
    assert not outputs.sure((0.113, 0.113))
    assert outputs.sure((0.17, 0.17))
    outputs.check_levels([0.1], (0.17, 0.17), report)
    assert found == ["silent"]


@pytest.mark.parametrize("by_a_set", [False, True])
@pytest.mark.parametrize(("begins", "is_known"), [(1.01, True), (1.02, False), (1.03, True)])
def test_way_to_silence_that_a_ramp_may_shorten_or_not_is_unknown_until_both_are_over(
    begins: float, is_known: bool, by_a_set: bool
) -> None:
    """By hand: an ending or an onset to 0 of 40 ms begins within 1.000 to 1.002 s.

    A ramp of 20 ms begins within 2.5 ms, of a silence or of a set. From 1.01 s on it arrives before
    the way, from 1.03 s on behind it; from 1.02 s on within 1.0400 to 1.0425 s, and the way within
    1.040 to 1.042 s.
    """
    outputs, report, found = expecting()
    way, when = Envelope(100, ((5000, 0),) * 3), (begins, begins + 0.0005)
    if by_a_set:
        rises = Command(0, 2200, 0, 0, onset=way)
        outputs.play([LayerSet(0, 0, 0, (rises,))], 1, (1.0, 1.0), is_exact=True)
        outputs.play([LayerSet(0, 20, 0, ())], 2, when, is_exact=True)
    else:
        ends = Command(0, 2200, 5000, 0, ending=way)
        outputs.play([LayerSet(0, 0, 0, (ends,))], 1, (0.0, 0.0), is_exact=True)
        outputs.play([LayerSet(0, 20, 0, ())], 2, (1.0, 1.0), is_exact=True)
        outputs.silence(when, 0.02, "Silence")
    assert bool(outputs.sure((begins + 0.003, begins + 0.003))) is is_known
    assert outputs.sure((1.06, 1.06))
    outputs.check_levels([0.1], (1.06, 1.06), report)
    assert found == ["plays" if by_a_set else "silent"]


def test_tones_that_may_cancel_leave_those_of_other_frequencies_what_they_play() -> None:
    """By hand: 0.5 at 20 Hz lasts; three tones of 0.3 at 110 Hz cancel, or are added up to 0.9."""
    bounds = UncertainPlayback(Playback(1, 8))
    thirds = [(2200, 3000, degrees) for degrees in (0, 12000, -12000)]
    for number, (frequency, level, phase) in enumerate([(400, 5000, 0), *thirds]):
        one = LayerSet(number, 0, 0, (Command(0, frequency, level, phase),))
        bounds.commit([one], number + 1, (0.1 * number, 0.1 * number + 0.001))
    assert bounds.bounds(0, 1.0, 1.01) == pytest.approx((0.5, 1.4))
    assert bounds.bounds(0, 1.0, 1.01, is_exact=True) == pytest.approx((0.5, 0.5))


def test_bounds_are_no_wider_than_need_be() -> None:
    """By hand: a rise to 0.5 along 100 ms that began within 2 ms is at 0.25 at half, +/- 0.008."""
    bounds = UncertainPlayback(Playback(1, 8))
    bounds.commit([LayerSet(0, 100, 0, (Command(0, 2200, 5000, 0),))], 1, (0.0, 0.002))
    low, high = bounds.bounds(0, 0.051, 0.051)
    # The steepest change of a raised cosine is pi/2 of its height in its duration.
    steepest = 0.5 * 3.1416 / 2 / 0.1 * 0.001
    assert 0.25 - 1.001 * steepest <= low < 0.25 < high <= 0.25 + 1.001 * steepest
    bounds.commit([LayerSet(0, 0, 0, (Command(0, 2200, 5000, 0, True),))], 2, (0.2, 0.21))
    assert bounds.bounds(0, 0.22, 0.23) == pytest.approx((0.5, 0.5))

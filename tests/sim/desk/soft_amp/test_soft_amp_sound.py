"""A software amplifier through a real JACK server, as a client that captures it hears it."""

import os
import signal
from collections.abc import Awaitable, Callable, Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from benchmarks.desk.capture import Capture
from drivers.host.amplifier import Amplifier
from drivers.opening import Lines
from drivers.protocol.definition import FAULTS, STATES
from gateway_bench import wait_for
from model.errors import InputError
from sim.soft_amp.engine import Protocol, Settings
from sim.soft_amp.output import open_output
from sound_cards import BLOCK, RATE, SoftAmp, capture_on, host, jack_server
from steady_host import WATCHDOG, linear_amplifier

pytestmark = [
    pytest.mark.real_time,
    pytest.mark.needs("jackd", "cc"),
]

CHANNELS = 3
SETTINGS = Settings(device="jack:card", channels=2, protocol=Protocol.SERIAL, serial_number="S")
SILENCE = 0.05  # s of samples; what the command promises once it is killed


@pytest.fixture(scope="module")
def sound(tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[Capture, dict[str, str]]]:
    """A client that captures, and the environment in which its server is found."""
    name = f"era{os.getpid()}"
    with jack_server(name) as server:
        capture = capture_on(name, "card", CHANNELS)
        yield capture, server.environment
        capture.close()


@pytest.fixture(scope="module")
def amp(
    sound: tuple[Capture, dict[str, str]], tmp_path_factory: pytest.TempPathFactory
) -> Iterator[SoftAmp]:
    """An amplifier that plays to it, through JACK itself."""
    folder = tmp_path_factory.mktemp("amp")
    options = ("--device", "jack:card", "--channels", str(CHANNELS), "--link", str(folder / "amp"))
    soft_amp = SoftAmp(*options, environment=sound[1], log=folder / "log")
    yield soft_amp
    soft_amp.end()


def test_samples_are_those_of_the_page(sound: tuple[Capture, dict[str, str]], amp: SoftAmp) -> None:
    """Level x sin(2 pi f t + phase) within 0.1 dB, and within 0.1 degrees between channels."""
    capture, _ = sound
    with host(amp.url, CHANNELS) as playing:
        wait_for(capture.is_sounding)
        _wait_for_samples(capture, 0.3)  # 0.2 s of soft start and ramp
        samples = capture.samples(RATE // 10)
        turning = np.exp(-2j * np.pi * 1000 * np.arange(len(samples)) / RATE)
        amplitudes = 2 * (samples * turning[:, None]).mean(axis=0)
        np.testing.assert_allclose(20 * np.log10(np.abs(amplitudes) / 0.5), 0, atol=0.1)
        steps = np.degrees(np.angle(amplitudes[1:] / amplitudes[:-1]))
        np.testing.assert_allclose(steps, 30, atol=0.1)
        playing.kill()
        killed = capture.position
        wait_for(lambda: not capture.is_sounding())
        assert capture.end_of_sound() - killed < RATE * (WATCHDOG + SILENCE)


@pytest.mark.parametrize("how", [signal.SIGKILL, signal.SIGSTOP])
async def test_killed_or_stopped_player_is_silent_and_then_in_fault(
    sound: tuple[Capture, dict[str, str]], amp: SoftAmp, how: signal.Signals
) -> None:
    """No sound once it is gone; its line stays, reports the fault, and is disarmed once cleared."""
    capture, _ = sound
    with host(amp.url, CHANNELS):
        wait_for(capture.is_sounding)
        player, reopened = amp.player, amp.log.count("open again")
        os.kill(player, how)
        done = capture.position
        wait_for(lambda: amp.log.count("open again") > reopened)
        assert capture.end_of_sound() - done < RATE * SILENCE
        assert amp.player != player
    lines = Lines()
    amplifier = await linear_amplifier(lines, amp.url)
    await amplifier.open()
    status = await amplifier.read_status()
    assert (status["state"], status["fault"]) == (STATES["FAULT"], FAULTS["INTERNAL"])
    assert (await amplifier.clear())["state"] == STATES["SWITCH_ON_DISABLED"]
    await lines.close()


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


@pytest.mark.parametrize(
    ("changed", "key"),
    [
        ({"channels": CHANNELS + 1}, "--device"),
        ({"rate": 96_000}, "--rate"),
        ({"block": 2 * BLOCK}, "--block"),
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


@pytest.mark.needs("portaudio")
@pytest.mark.parametrize("line", ["--tcp", "--modbus-tcp"])
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
        forces = 2 * capture.samples(RATE) ** 2 - 1  # u = sqrt((1 + force) / 2)
        windows = forces.reshape(20, RATE // 20, 2)
        levels = np.abs(np.fft.rfft(windows, axis=1)[:, 1000 // 20]) / (RATE // 40)
        np.testing.assert_allclose(np.median(levels, axis=0), 0.5, rtol=0.011)
        soft_amp.process.kill()
        killed = capture.position
        wait_for(lambda: not player.exists())
        assert capture.end_of_sound() - killed < RATE * SILENCE
    soft_amp.end()
    capture.close()


def _wait_for_samples(capture: Capture, seconds: float) -> None:
    end = capture.position + RATE * seconds
    wait_for(lambda: capture.position > end)

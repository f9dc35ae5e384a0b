"""What a sound card of a real JACK server, or of PortAudio over it, is refused for, and lost by.

A process has one server at a time, and PortAudio keeps it: commands try PortAudio.
"""

import os
import subprocess
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest

from drivers.errors import LinkError
from era_haptics.lab.measuring.sound_card import SoundCard, open_card
from gateway_bench import wait_for
from model.errors import InputError
from sim.soft_amp.engine import Protocol, Settings
from sim.soft_amp.output import open_output
from sound_cards import JackServer, capture_on, jack_server
from typed_page import ERA

pytestmark = [
    pytest.mark.real_time,
    pytest.mark.needs("jackd", "cc"),
]

DESK = Path(__file__).parents[3] / "examples" / "desk"
STALLED = 8.0  # s; without a message of the server it would be ten
CHANNELS = 5  # of that desk: four ERAs and the loop-back
SETTINGS = Settings(
    device="jack:card", channels=CHANNELS, protocol=Protocol.SERIAL, serial_number="S"
)


@pytest.fixture
def server() -> Iterator[JackServer]:
    """A server with a client of this process, `card`, that takes as many channels."""
    name = f"card{os.getpid()}"
    with pytest.MonkeyPatch.context() as patch, jack_server(name) as running:
        patch.setenv("JACK_DEFAULT_SERVER", name)
        capture = capture_on(name, "card", CHANNELS)
        yield running
        capture.close()


def card(device: str, *, outputs: int = CHANNELS, inputs: int = 0) -> SoundCard:
    """A card that is opened."""
    return open_card(device, outputs=outputs, inputs=inputs, limit=1.0)


def refusal(server: JackServer, *arguments: str) -> tuple[int, str]:
    """Exit status and message of a command."""
    done = subprocess.run(
        [ERA, *arguments],
        stdin=subprocess.DEVNULL,
        capture_output=True,
        text=True,
        env=server.environment,
        check=False,
    )
    assert done.stdout == ""
    return done.returncode, done.stderr


def measure(server: JackServer, device: str, folder: Path) -> tuple[int, str]:
    """Exit status and message of a measurement that is refused."""
    sensors, found = str(DESK / "sensors.csv"), str(folder / "m.csv")
    return refusal(
        server, "measure", str(DESK / "rig.yaml"), "--device", device, "--sensors", sensors,
        "-o", found,
    )  # fmt: skip


@pytest.mark.needs("portaudio")
def test_unsuitable_cards_are_refused(server: JackServer, tmp_path: Path) -> None:
    """No such one; too few channels; no inputs: one message, exit status 2, and no file."""
    for device, ports, cause in (
        ("jack:nothing", {}, "5 outputs, got 0"),
        ("jack:card", {"outputs": CHANNELS + 1}, "6 outputs, got 5"),
        ("jack:card", {"inputs": 1}, "1 inputs, got 0"),
    ):
        with pytest.raises(InputError, match=cause):
            card(device, **ports)
    for device, cause in (("card", "inputs, got 0"), ("no such device", "no such device")):
        status, message = measure(server, device, tmp_path)
        assert (status, message.count("\n")) == (2, 1)
        assert cause in message
    assert not any(tmp_path.iterdir())


@pytest.mark.needs("portaudio")
def test_card_that_is_played_to_is_busy(server: JackServer) -> None:
    """For measurement and amplifier, also by PortAudio: JACK would add up what two play.

    A device that there is not is one message, too.
    """
    playing = card("jack:card")
    with pytest.raises(LinkError, match="busy"):
        card("jack:card")
    with pytest.raises(LinkError, match="busy"):
        open_output(SETTINGS)
    for device, status, cause in (("card", 3, "busy"), ("no such device", 2, "no such device")):
        done = refusal(server, "soft-amp", "--device", device, "--channels", "2")
        assert (done[0], done[1].count("\n"), cause in done[1]) == (status, 1, True)
    playing.close()


def test_measurement_without_its_server_is_lost(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """Ended while a run plays: one message and exit status 3 at once; then there is none."""
    name = f"lost{os.getpid()}"
    monkeypatch.setenv("JACK_DEFAULT_SERVER", name)
    with jack_server(name, inputs=13, outputs=CHANNELS) as server:
        looking = capture_on(name, "looking", 1)  # once the server is up
        with ThreadPoolExecutor() as thread:
            measuring = thread.submit(measure, server, "jack", tmp_path)
            wait_for(lambda: looking.is_played_to("era-measure:in_13"))  # the last to be connected
            looking.close()  # libjack does not bear to close a client of a server that is gone
            server.process.terminate()  # one that is killed occupies one of JACK's eight places
            ended = time.monotonic()
            status, message = measuring.result()
        assert (status, message.count("\n"), "lost" in message) == (3, 1, True)
        assert time.monotonic() - ended < STALLED
        status, message = measure(server, "jack", tmp_path)
        assert (status, "no server" in message) == (3, True)
    assert not any(tmp_path.iterdir())


@pytest.mark.needs("portaudio")
def test_rate_that_gives_no_whole_milliseconds_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    """44.1 kHz of a server or device, for an amplifier; a measurement takes any whole one."""
    name = f"rate{os.getpid()}"
    monkeypatch.setenv("JACK_DEFAULT_SERVER", name)
    with jack_server(name, rate=44_100) as server:
        capture = capture_on(name, "card", CHANNELS)
        with pytest.raises(InputError, match=r"multiple of 1000 Hz.*got 44100 Hz"):
            open_output(SETTINGS)
        status, message = refusal(server, "soft-amp", "--device", "card", "--channels", "2")
        assert (status, "got 44100 Hz" in message) == (2, True)
        measuring = card("jack:card")
        assert measuring.rate == 44_100
        measuring.close()
        capture.close()

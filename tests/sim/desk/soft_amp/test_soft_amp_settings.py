"""What a software amplifier refuses before any sound device is opened."""

import json
from dataclasses import asdict
from pathlib import Path
from types import SimpleNamespace

import pytest

from model.errors import InputError
from sim.soft_amp.engine import Law, Place, Protocol, Settings, compile_engine, terminal_place
from sim.soft_amp.jack import NoSound
from sim.soft_amp.output import PortAudioOutput, portaudio_stream


def settings(**changed: object) -> Settings:
    """Settings of four channels, changed."""
    values: dict[str, object] = {
        "device": "jack",
        "channels": 4,
        "protocol": Protocol.SERIAL,
        "serial_number": "S",
    }
    return Settings(**(values | changed))  # type: ignore[arg-type]


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
    assert Settings(**json.loads(json.dumps(asdict(given)))) == given
    assert Place("serial:///x").urls(given.amplifiers, protocol=Protocol.SERIAL) == [
        "serial:///x",
        "serial:///x?address=2",
    ]
    urls = Place("modbus+tcp://h:1").urls(given.amplifiers, protocol=Protocol.MODBUS)
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

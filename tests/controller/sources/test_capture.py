"""Recorded TUIO streams, and files that are none."""

import asyncio
import socket
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from controller.cli.main import run
from controller.sources.tuio import (
    HEADER,
    MAX_BYTES,
    RecordedDatagram,
    read_capture,
    replay_capture,
)
from drivers.errors import LinkError
from examples.make_touches import write_capture
from model.errors import InputError
from virtual_lines import in_virtual_time


@given(
    st.lists(
        st.tuples(st.integers(0, 10**8), st.binary(min_size=1, max_size=40)), min_size=1, max_size=9
    )
)
def test_capture_round_trip(
    tmp_path_factory: pytest.TempPathFactory, sent: list[tuple[int, bytes]]
) -> None:
    """What was written to a microsecond comes back, malformed datagrams too."""
    path = tmp_path_factory.mktemp("capture") / "stream.tuio"
    datagrams = [RecordedDatagram(micros / 1e6, payload) for micros, payload in sorted(sent)]
    write_capture(path, datagrams)
    assert read_capture(path) == datagrams


def test_read_capture_reads_the_documented_format(tmp_path: Path) -> None:
    """The format as documented, comments included, is read."""
    path = tmp_path / "golden.tuio"
    path.write_text(f"{HEADER}\n# two fingers\n0 2f00ff\n1.5 0a\n", encoding="ascii")
    assert read_capture(path) == [
        RecordedDatagram(0.0, b"\x2f\x00\xff"),
        RecordedDatagram(1.5, b"\n"),
    ]


@in_virtual_time
async def test_replay_capture_keeps_times_over_udp() -> None:
    """Datagrams arrive unchanged, each at its own time."""
    loop = asyncio.get_running_loop()
    start = loop.time()
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as receiver:
        receiver.bind(("127.0.0.1", 0))
        receiver.setblocking(False)
        datagrams = [
            RecordedDatagram(0.0, b"one"),
            RecordedDatagram(0.25, b"two"),
            RecordedDatagram(1.0, b"three"),
        ]
        port = receiver.getsockname()[1]
        replay = asyncio.create_task(replay_capture(datagrams, "127.0.0.1", port))
        received = [(await loop.sock_recv(receiver, 100), loop.time() - start) for _ in datagrams]
        await replay
    assert received == [(b"one", 0.0), (b"two", 0.25), (b"three", 1.0)]


@in_virtual_time
async def test_replay_capture_raises_when_the_port_is_closed() -> None:
    """The refusal of one datagram is raised at the next."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as closed:
        closed.bind(("127.0.0.1", 0))
        port = closed.getsockname()[1]
    with pytest.raises(LinkError, match=rf"127.0.0.1:{port} \(Connection refused\)"):
        await replay_capture(
            [RecordedDatagram(t, b"x") for t in (0.0, 0.1, 0.2)], "127.0.0.1", port
        )


@in_virtual_time
async def test_replay_capture_raises_when_the_system_refuses() -> None:
    """An address to which the system may not send is reported at once."""
    with pytest.raises(LinkError, match=r"255\.255\.255\.255:3333 \(Perm"):
        await replay_capture([RecordedDatagram(0.0, b"x")], "255.255.255.255", 3333)


def test_era_touch_sends_a_capture(tmp_path: Path) -> None:
    """To the UDP port of the daemon's source; fingers and a capture exclude each other."""
    commands = ["controller.cli.commands"]
    path = tmp_path / "taps.tuio"
    write_capture(path, [RecordedDatagram(0.0, b"one"), RecordedDatagram(0.0, b"two")])
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as receiver:
        receiver.bind(("127.0.0.1", 0))
        receiver.settimeout(10)
        options = ["--replay", str(path), "--port", str(receiver.getsockname()[1])]
        assert run(["touch", *options], commands) == 0
        assert [receiver.recv(100) for _ in range(2)] == [b"one", b"two"]
        assert run(["touch", "0.1,0.1", *options], commands) == 2
    assert run(["touch"], commands) == 2


def test_capture_has_a_maximum_size(tmp_path: Path) -> None:
    """A sparse file one byte above it is refused before it is read as text; so is a datagram's."""
    path = tmp_path / "long"
    with path.open("wb") as stream:
        stream.truncate(MAX_BYTES + 1)
    with pytest.raises(InputError, match="16 MiB"):
        read_capture(path)
    path.write_text(f"{HEADER}\n1 {'00' * 65508}\n")
    with pytest.raises(InputError, match=r"line 2.*65507"):
        read_capture(path)

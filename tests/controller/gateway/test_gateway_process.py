"""`era gateway` as a process: how it begins, what it refuses, TLS, and its end within a second."""

import asyncio
import os
import signal
import socket
import ssl
import subprocess
import sys
import time
from pathlib import Path

import pytest

from controller.gateway.serving import listen
from controller.gateway.settings import Settings, read_token
from gateway_bench import (
    ERA,
    TOKEN,
    RawWebSocket,
    ScriptedDaemon,
    gateway_process,
    http,
    raw,
    upgrade,
    wait_for,
    wait_for_daemon,
)
from model.errors import InputError


@pytest.fixture(scope="module")
def pair(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """A self-signed certificate of localhost, and its key."""
    folder = tmp_path_factory.mktemp("tls")
    certificate, key = folder / "panel.pem", folder / "panel.key"
    subprocess.run(
        [
            *("openssl", "req", "-x509", "-newkey", "ec", "-pkeyopt", "ec_paramgen_curve:P-256"),
            *("-nodes", "-days", "1", "-subj", "/CN=localhost"),
            *("-addext", "subjectAltName=DNS:localhost,IP:127.0.0.1"),
            *("-keyout", str(key), "-out", str(certificate)),
        ],
        check=True,
        capture_output=True,
    )
    return certificate, key


def refused(*options: object) -> str:
    """What `era gateway` says when it does not begin."""
    done = subprocess.run(
        [ERA, "gateway", *map(str, options)],
        capture_output=True,
        text=True,
        timeout=60,
        check=False,
    )
    assert done.returncode == 2
    assert done.stdout == ""
    assert "Traceback" not in done.stderr
    return " ".join(done.stderr.split())


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT])
def test_told_to_end_it_is_gone_within_a_second(
    daemon: ScriptedDaemon, tmp_path: Path, number: signal.Signals
) -> None:
    """With WebSockets open, one of which never reads, a request that never ends, and one held."""
    with gateway_process(tmp_path, daemon.socket) as gateway:
        wait_for_daemon(gateway)
        with (
            daemon.holding(),
            RawWebSocket(gateway) as ws,
            RawWebSocket(gateway) as deaf,
            gateway.connect() as slow,
            gateway.connect() as held,
        ):
            for id in range(100):
                deaf.ask("hello", {"client": "me"}, id=id)
            slow.sendall(b"POST /api/v1/arm HTTP/1.1\r\n")
            held.sendall(
                f"POST /api/v1/arm HTTP/1.1\r\nHost: {gateway.host}\r\nAuthorization: Bearer "
                f"{TOKEN}\r\nContent-Type: application/json\r\nContent-Length: 29\r\n\r\n"
                '{"owner": "me", "lease_s": 5}'.encode()
            )
            wait_for(lambda: "arm" in daemon.methods)
            ws.ask("effects", {})
            assert ws.answer()["result"]
            told = time.monotonic()
            gateway.process.send_signal(number)
            assert gateway.process.wait(20) == 0
            assert time.monotonic() - told < 1.0
            assert ws.close_code() == 1012  # the service restarts
        assert gateway.said() == ""


def test_it_finds_a_daemon_that_comes_later(tmp_path: Path) -> None:
    """Without one it says so, and how to mend it; once there is one it serves."""
    with gateway_process(tmp_path, tmp_path / "era.sock") as gateway:
        answer = http(gateway)
        assert answer.status == 503
        assert b"no daemon runs at" in answer.body
        for _ in range(2):
            with ScriptedDaemon(tmp_path) as daemon:
                wait_for_daemon(gateway)
                assert http(gateway).status == 200
                assert daemon.methods == ["arm"]
            wait_for(lambda: http(gateway).status == 503)


def test_it_makes_a_token_that_is_another_each_time(daemon: ScriptedDaemon, tmp_path: Path) -> None:
    """The URL that it prints holds it; whoever opens that is let in."""
    tokens = []
    for _ in range(2):
        with gateway_process(tmp_path, daemon.socket, token=None) as gateway:
            wait_for(lambda: http(gateway, token=[gateway.token]).status == 200)
            assert {http(gateway, token=[old]).status for old in tokens} <= {401}
            tokens.append(gateway.token)
    assert len(set(tokens)) == 2
    assert all(len(token) == 43 for token in tokens)  # 256 bits


def test_it_speaks_tls(daemon: ScriptedDaemon, tmp_path: Path, pair: tuple[Path, Path]) -> None:
    """HTTP and WebSockets over a verified certificate; without TLS nothing is answered."""
    certificate, key = pair
    options = ("--certificate", str(certificate), "--key", str(key))
    with gateway_process(tmp_path, daemon.socket, *options) as gateway:
        assert gateway.url.startswith("https://")
        plain = f"POST /api/v1/stop HTTP/1.1\r\nHost: {gateway.host}\r\n\r\n".encode()
        assert raw(gateway, plain).status == 0
        gateway.context = _Verified(certificate)
        wait_for_daemon(gateway)
        assert http(gateway).status == 200
        assert http(gateway, more=[f"Origin: https://{gateway.host}"]).status == 200
        assert http(gateway, more=[f"Origin: http://{gateway.host}"]).status == 403
        assert raw(gateway, upgrade(gateway, origin=f"http://{gateway.host}")).status == 403
        with gateway.connect() as connection:
            connection.sendall(upgrade(gateway, origin=f"https://{gateway.host}"))
            assert connection.recv(1 << 16).startswith(b"HTTP/1.1 101 ")
            told = time.monotonic()
            assert gateway.end() == 0
            assert time.monotonic() - told < 1.0


class _Verified(ssl.SSLContext):
    """Trusts one certificate, and takes the server for localhost."""

    def __new__(cls, certificate: Path) -> "_Verified":
        return super().__new__(cls, ssl.PROTOCOL_TLS_CLIENT)

    def __init__(self, certificate: Path) -> None:
        self.load_verify_locations(certificate)

    def wrap_socket(self, plain: socket.socket) -> ssl.SSLSocket:  # type: ignore[override]
        """As a client of localhost."""
        return super().wrap_socket(plain, server_hostname="localhost")


def test_over_ipv6_the_url_that_is_printed_can_be_opened(
    daemon: ScriptedDaemon, tmp_path: Path
) -> None:
    """On the loopback, by its own name in brackets and no other."""
    with gateway_process(tmp_path, daemon.socket, "--listen", "[::1]:0") as gateway:
        assert gateway.url.startswith("http://[::1]:")
        wait_for_daemon(gateway)
        assert http(gateway, more=[f"Origin: http://{gateway.host}"]).status == 200
        assert http(gateway, host=["evil.example"]).status == 421


def test_beyond_this_machine_the_url_has_a_name_that_browsers_can_call(
    daemon: ScriptedDaemon, tmp_path: Path, pair: tuple[Path, Path]
) -> None:
    """Listening everywhere, the first allowed host is shown, and no token."""
    options = ("--listen", "0.0.0.0:0", "--allow-host", "localhost.test")
    options += ("--certificate", str(pair[0]), "--key", str(pair[1]))
    with gateway_process(tmp_path, daemon.socket, *options) as gateway:
        assert gateway.url.startswith("https://localhost.test:")


@pytest.mark.parametrize("host", ["127.0.0.1", "::1"])
async def test_an_answer_waits_for_no_acknowledgement(host: str, tmp_path: Path) -> None:
    """What is sent in pieces, head and body, leaves at once, on a connection that is kept, too.

    Without TCP_NODELAY the second piece waits until the other side acknowledges the first: 40 ms.
    """
    accepted: asyncio.Queue[asyncio.StreamWriter] = asyncio.Queue()
    listening = listen(Settings(socket=tmp_path / "era.sock", host=host, port=0))
    async with await asyncio.start_server(
        lambda _, writer: accepted.put_nowait(writer), sock=listening
    ):
        _, ours = await asyncio.open_connection(host, listening.getsockname()[1])
        theirs = await accepted.get()
        connection = theirs.get_extra_info("socket")
        assert connection.getsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY)
        for writer in (ours, theirs):
            writer.close()


def test_a_port_that_is_taken_is_told(tmp_path: Path) -> None:
    """With the port, and what to do."""
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
        said = refused("--listen", f"127.0.0.1:{port}")
    assert f"cannot listen on 127.0.0.1 port {port} (Address already in use)" in said
    assert "name another port" in said


def test_without_the_extra_it_says_what_to_install(tmp_path: Path) -> None:
    """The command is there, and tells; so does nothing else of `era` need the libraries."""
    code = (
        "import sys; sys.modules['starlette'] = None; sys.argv = ['era', 'gateway'];"
        "from controller.cli.main import main; sys.exit(main())"
    )
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, timeout=60, check=False
    )
    assert done.returncode == 2
    assert "pip install 'era-haptics[gateway]'" in " ".join(done.stderr.split())


def test_certificates_that_cannot_be_used_are_told(tmp_path: Path, pair: tuple[Path, Path]) -> None:
    """A key of another certificate, a key with a password, and no certificate at all."""
    certificate, _ = pair
    other, locked = tmp_path / "other.key", tmp_path / "locked.key"
    new = ("openssl", "genpkey", "-algorithm", "EC", "-pkeyopt", "ec_paramgen_curve:P-256")
    for path, more in ((other, ()), (locked, ("-aes256", "-pass", "pass:secret"))):
        subprocess.run([*new, *more, "-out", str(path)], check=True, capture_output=True)
    text = tmp_path / "text"
    text.write_text("no certificate")
    for first, second in ((certificate, other), (certificate, locked), (text, text)):
        said = refused("--listen", "127.0.0.1:0", "--certificate", first, "--key", second)
        assert f"{first} and {second} cannot be used for TLS" in said
        assert "the key without password" in said


def test_a_token_is_taken_from_a_file_of_ones_own(tmp_path: Path) -> None:
    """With a line's end after it."""
    file = tmp_path / "token"
    file.write_text(f"{TOKEN}\n")
    file.chmod(0o600)
    assert read_token(file) == TOKEN


def test_token_files_that_others_may_read_or_that_are_none_are_refused(tmp_path: Path) -> None:
    """Each with what is wrong; a pipe is not waited for, an endless file not read."""
    file = tmp_path / "token"
    file.write_text(TOKEN)
    for mode in (0o640, 0o604, 0o620):
        file.chmod(mode)
        with pytest.raises(
            InputError, match="others may read this token; forbid it with chmod 600"
        ):
            read_token(file)
    pipe = tmp_path / "pipe"
    os.mkfifo(pipe, 0o600)
    for path in (pipe, Path("/dev/zero"), tmp_path):
        with pytest.raises(InputError, match=r"is no text file|cannot be read"):
            read_token(path)
    with pytest.raises(InputError, match=r"cannot be read \(No such file.*--token-file wants"):
        read_token(tmp_path / "missing")
    file.chmod(0o600)
    file.write_bytes(b"\xff" * 30)
    with pytest.raises(InputError, match="is no text file"):
        read_token(file)


def test_a_token_file_of_somebody_else_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """They could read it, whatever its mode."""
    file = tmp_path / "token"
    file.write_text(TOKEN)
    file.chmod(0o600)
    if file.stat().st_uid == 0:  # as root, every file of root's is trusted: give it away
        os.chown(file, 12345, -1)
    else:
        monkeypatch.setattr(os, "geteuid", lambda: file.stat().st_uid + 1)
    with pytest.raises(InputError, match="belongs to somebody else"):
        read_token(file)


SETTINGS: dict[str, tuple[dict[str, object], str]] = {
    "port": ({"port": 65536}, "0 to 65535 are ports"),
    "name": ({"host": "localhost"}, "give an address"),
    "short token": ({"token": "secret"}, "22 to 128 letters"),
    "token with a space": ({"token": "a b" * 20}, "22 to 128 letters"),
    "certificate alone": ({"certificate": Path("x")}, "needs a certificate and its key"),
    "missing certificate": ({"certificate": Path("x"), "key": Path("x")}, "there is no such file"),
    "beyond, nothing": ({"host": "0.0.0.0"}, "only with TLS and a token"),
    "beyond, IPv6": ({"host": "::"}, "only with TLS and a token"),
    "beyond, a token alone": ({"host": "192.0.2.1", "chose_token": True}, "only with TLS"),
    "any host": ({"names": ("*",)}, "no host name"),
    "host with a port": ({"names": ("panel.local:80",)}, "without port"),
    "IPv6 host without brackets": ({"names": ("2001:db8::7",)}, r"\[2001:db8::7\]"),
    "origin with a path": ({"origins": ("https://panel.example/x",)}, "is no origin"),
    "origin null": ({"origins": ("null",)}, "is no origin"),
    "any origin": ({"origins": ("*",)}, "is no origin"),
}


@pytest.mark.parametrize("name", SETTINGS)
def test_what_would_be_unsafe_is_refused(name: str) -> None:
    """Before anything listens, with what to do."""
    given, words = SETTINGS[name]
    with pytest.raises(InputError, match=words):
        Settings(socket=Path("era.sock"), **given)  # type: ignore[arg-type]


def test_another_address_of_the_loopback_is_called_by_itself() -> None:
    """As its URL has it; by no other of that net."""
    settings = Settings(socket=Path("era.sock"), host="127.0.0.2")
    assert settings.shown_host == "127.0.0.2"
    assert settings.allowed_names == {"localhost", "127.0.0.1", "[::1]", "127.0.0.2"}


def test_beyond_this_machine_it_wants_tls_a_token_and_a_name(pair: tuple[Path, Path]) -> None:
    """With all three it may; without the name, or with a token of its own making, it may not."""
    certificate, key = pair
    for chose, names in ((False, ("panel.local",)), (True, ())):
        with pytest.raises(InputError, match=r"--token-file|--allow-host"):
            Settings(
                socket=Path("era.sock"),
                host="0.0.0.0",
                certificate=certificate,
                key=key,
                chose_token=chose,
                names=names,
            )


@pytest.mark.parametrize("listen", ["127.0.0.1", "127.0.0.1:-1"])
def test_where_to_listen_must_be_understood(listen: str) -> None:
    """What it is not is said, with what it looks like."""
    assert f"--listen {listen}: expected HOST:PORT" in refused("--listen", listen).replace(
        "  ", " "
    )

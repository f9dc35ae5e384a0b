"""An installed `era`, run from an empty folder where nothing of a checkout can be found.

Each step is what a user types first; Failed says which command did what else.
"""

import contextlib
import json
import os
import socket
import subprocess
import urllib.request
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

_TOKEN = "a-token-of-the-smoke-test"
PATIENCE = 120.0  # s; on a machine that is busy with other things


class Failed(AssertionError):
    """A command of the installed distribution did not do what it is for."""


@dataclass(frozen=True)
class InstalledEra:
    """The interpreter of an environment, beside which `era` lies, and where its commands run."""

    python: Path
    folder: Path

    def __call__(self, *arguments: str) -> str:
        """What `era` prints with these arguments; raises Failed where it does not end well."""
        return self._run(str(self.python.with_name("era")), *arguments)

    def module(self, *arguments: str) -> str:
        """What `python -m` prints with these arguments."""
        return self._run(str(self.python), "-m", *arguments)

    def script(self, text: str) -> str:
        """What a program prints."""
        return self._run(str(self.python), "-c", text).strip()

    @contextlib.contextmanager
    def running(self, *arguments: str) -> Iterator[subprocess.Popen[str]]:
        """Run an `era` until the end of the block, where it is terminated."""
        with subprocess.Popen(
            [self.python.with_name("era"), *arguments],
            cwd=self.folder,
            env=self._environment(),
            stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL,
            text=True,
        ) as process:
            try:
                yield process
            finally:
                process.terminate()
                process.wait(PATIENCE)

    def _run(self, *command: str) -> str:
        done = subprocess.run(
            command,
            cwd=self.folder,
            env=self._environment(),
            capture_output=True,
            text=True,
            timeout=PATIENCE,
            check=False,
        )
        if done.returncode != 0:
            raise Failed(f"{' '.join(command)}: {done.returncode}\n{done.stdout}{done.stderr}")
        return done.stdout

    def _environment(self) -> dict[str, str]:
        """That of the caller, without what leads to another Python or to the user's own files."""
        kept = {name: value for name, value in os.environ.items() if not name.startswith("PYTHON")}
        places = {"XDG_CACHE_HOME": "cache", "XDG_RUNTIME_DIR": "run"}
        return kept | {name: str(self.folder / place) for name, place in places.items()}


def try_first(era: InstalledEra) -> None:
    """Help, the example rig, and its plate's modes."""
    expect("Usage: era " in era("--help"), "help")
    era("config", "init", "rig.yaml")
    modes = json.loads(era("plate", "modes", "rig.yaml", "-n", "6", "--json"))
    expect(modes["frequencies_hz"] == sorted(modes["frequencies_hz"]), "modes out of order")


def try_files(era: InstalledEra) -> None:
    """Configuration files, a small table, a picture, a bug report; after `try_first`."""
    for kind in ("layout", "daemon"):
        era("config", "init", "--kind", kind, f"{kind}.yaml")
    for kind in ("rig", "layout", "daemon"):
        expect("good" in era("config", "check", f"{kind}.yaml"), f"the example of a {kind} is bad")
    coarse = ("--frequencies", "100:200:50", "--grid", "4x3", "--mesh", "12x9")
    era("table", "build", "rig.yaml", "-o", "small.npz", *coarse)
    asked = ("--target", "0.06,0.05", "--quiet", "0.2,0.1")
    answer = json.loads(era("table", "query", "small.npz", *asked, "--json"))
    expect(
        answer["fingers"][0]["contrast_db"] > 6.0, f"the two fingers are not told apart: {answer}"
    )
    era("plate", "map", "rig.yaml", "--drive", "SW=110", "--points", "12x9", "-o", "map.png")
    expect((era.folder / "map.png").stat().st_size > 1000, "no picture")
    era("report", "daemon.yaml", "-o", "report.zip")


def try_wire(era: InstalledEra) -> None:
    """A simulated amplifier on a pseudo-terminal, and what is asked of it by hand."""
    with era.running("sim", "rig.yaml", "--serial") as sim:
        assert sim.stdout is not None
        name, _, url = sim.stdout.readline().strip().partition(": ")
        expect(name == "main" and url.startswith("serial:"), f"not an amplifier: {name} {url}")
        expect("4" in era("amp", "identify", url), "an amplifier without channels")
        tone = ("--channel", "0", "--frequency", "110", "--level", "0.2", "--for", "0.2")
        era("amp", "drive", url, *tone)
        era("amp", "stop", url)


def try_demo(era: InstalledEra) -> None:
    """The demonstration: the recorded touches that come with it are felt as promised."""
    told = json.loads(era("demo", "--out", "demo", "--json"))
    pairs = [
        (touch["promised_contrast_db"], touch["measured_contrast_db"])
        for touch in told["touches"]
        if touch["steady"] and touch["promised_contrast_db"] is not None
    ]
    expect(len(pairs) > 5, "hardly a touch with others on the plate")
    kept = sum(promised <= felt for promised, felt in pairs)
    expect(kept >= 0.7 * len(pairs), f"not as promised: {pairs}")
    expect(all((era.folder / name).is_file() for name in told["files"]), "pictures are missing")


def try_gateway(era: InstalledEra) -> None:
    """A daemon and its page; needs the extra `gateway`."""
    (era.folder / "panel.yaml").write_text("rig: rig.yaml\ntable: small.npz\n", encoding="utf-8")
    (era.folder / "token").touch(mode=0o600)
    (era.folder / "token").write_text(f"{_TOKEN}\n", encoding="utf-8")
    listening = ("gateway", "--listen", "127.0.0.1:0", "--token-file", "token")
    with era.running("daemon", "panel.yaml"), era.running(*listening) as gateway:
        assert gateway.stdout is not None
        url = gateway.stdout.readline().split()[1]
        with urllib.request.urlopen(url, timeout=PATIENCE) as page:
            expect(b"<html" in page.read(), "no page")
        with urllib.request.urlopen(f"{url}app.js", timeout=PATIENCE) as program:
            expect(b"import" in program.read(), "a page without its program")
        expect("101 " in _websocket(url), "no WebSocket")


def _websocket(url: str) -> str:
    """The first line of what is answered to a WebSocket's handshake; its key is RFC 6455's."""
    host, _, port = url.removeprefix("http://").strip("/").partition(":")
    lines = [
        "GET /api/v1/ws HTTP/1.1",
        f"Host: {host}:{port}",
        "Upgrade: websocket",
        "Connection: Upgrade",
        "Sec-WebSocket-Version: 13",
        "Sec-WebSocket-Key: dGhlIHNhbXBsZSBub25jZQ==",
        f"Sec-WebSocket-Protocol: era-haptics.v1, era-haptics.token.{_TOKEN}",
    ]
    with socket.create_connection((host, int(port)), PATIENCE) as connection:
        connection.sendall("\r\n".join([*lines, "", ""]).encode())
        with connection.makefile(encoding="latin-1") as answer:
            return answer.readline()


def expect(holds: bool, what: str) -> None:
    """Raise Failed unless it holds."""
    if not holds:
        raise Failed(what)

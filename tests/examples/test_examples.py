"""The examples of plug-ins, amplifiers, clients, services and the plate for a weekend.

Amplifiers on pymodbus's server and in C, which share no table with the host, under conformance; a
wire behind a Unix socket; clients in JavaScript under Node.js; units of systemd, checked by systemd
itself; and the how-to pages for extensions, typed in order.
"""

import asyncio
import ctypes
import json
import math
import os
import re
import runpy
import shlex
import shutil
import subprocess
import sys
import tempfile
from asyncio.subprocess import PIPE
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager, closing
from functools import partial
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml

from controller.api.link import default_socket
from drivers import opening
from drivers.by_hand.actions import identify_amplifier
from drivers.errors import CommandError, LinkError
from drivers.host.amplifier import Amplifier
from drivers.host.group import Group
from drivers.opening import Lines
from drivers.playing import AmplifierLayer, AmplifierTone
from drivers.wires.serial_frames import Frame, encode_frame
from era_haptics.command import run_era
from era_haptics.lab.conformance.contract import of_kind
from era_haptics.lab.conformance.session import judge
from kit.clock import judged
from kit.weekend_boards import BuiltBoard
from model.rig.rig_file import load_rig
from packages import PACKAGES
from processes.daemons import (
    ENABLED,
    PATIENCE,
    READY,
    DaemonBench,
    next_event,
    ready_daemon,
    until_state,
)
from processes.typed_page import Reader, installed_program, read_steps
from registry.limits import GuardLimits
from sim.amplifier.simulated_amplifier import SimulatedAmplifier
from sim.far_ends.serial_amplifiers import SerialAmplifiers
from sim.transport.pseudo_terminal import make_terminal

ROOT = Path(__file__).parents[2]
PLUGINS = ROOT / "examples" / "plugins"
UNITS, WEEKEND = ROOT / "examples" / "systemd", ROOT / "examples" / "weekend"
MODULES = sorted(PLUGINS.glob("*/*.py"))


def test_heartbeat_has_no_end() -> None:
    """It lasts as long as the finger, so a layout refuses it under `on_release`."""
    assert runpy.run_path(str(PLUGINS / "effect" / "heartbeat.py"))["Heartbeat"]().has_end is False


@pytest.mark.parametrize("path", MODULES, ids=[path.stem for path in MODULES])
def test_example_plugin_imports_stable_names_only(path: Path) -> None:
    """Of this project plug-ins import `era_haptics` only."""
    imported = re.findall(r"^\s*(?:from|import) ([\w.]+)", path.read_text("utf-8"), re.MULTILINE)
    homes = {name.partition(".")[0] for name in imported}
    assert homes & (set(PACKAGES) - {"era_haptics"}) == set()


@pytest.mark.long
def test_the_board_is_found_from_the_file_of_its_sensor(tmp_path: Path, capsys) -> None:
    """Modulus within 2 % of that built, held-out places within 5 %, and drives known to 10 %.

    No sheet tells force factors to less than 20 %; with its gain each is known by the responses.
    """
    calibrated = tmp_path / "calibrated.yaml"
    believed = shutil.copy(WEEKEND / "rig.yaml", tmp_path)
    arguments = [str(believed), str(WEEKEND / "measured.uff"), "-o", str(calibrated)]
    assert run_era(["calibrate", *arguments, "--json"]) == 0
    report = json.loads(capsys.readouterr().out)
    assert report["held_out"]["error_after"] < 0.05
    true = BuiltBoard.drawn(load_rig(WEEKEND / "rig.yaml"), 0).rig.plate
    rig = load_rig(calibrated)
    rigidity = rig.plate.flexural_rigidity / rig.plate.mass
    assert rigidity == pytest.approx(true.flexural_rigidity / true.mass, rel=0.02)
    assert rig.uncertainty.gain < 0.1
    sizes, errors = (
        np.concatenate([gains[key] for gains in report["gains"].values()])
        for key in ("magnitude", "standard_error")
    )
    assert np.median(errors / sizes) < 0.1


EXAMPLE = ROOT / "examples" / "modbus_server" / "modbus_server.py"
FAILED = {"pieces", "exceptions"}
"""What docs/how-to/write-an-amplifier.md says that the server cannot do."""
SKIPPED = {"sensors", "steps_as_stated", "limited", "readings", "events"}
BY_MACHINE = {"clock_rate", "replies_in_time"}
"""What is skipped or fails, with that reason, where the machine of the test is slow."""


@asynccontextmanager
async def served(kind: str) -> AsyncIterator[str]:
    """The example on a TCP port, or on a pseudo-terminal that is joined to another; its URL."""
    near_end = make_terminal(lambda data: far_end.write(data))
    far_end = make_terminal(near_end.write)
    with closing(near_end), closing(far_end):
        for terminal in (near_end, far_end):
            terminal.listen()
        place = ["0"] if kind == "tcp" else [far_end.port, "N"]
        command = sys.executable, str(EXAMPLE), kind, *place
        process = await asyncio.create_subprocess_exec(*command, stdout=PIPE)
        try:
            url = (await process.stdout.readline()).decode().strip()
            yield url.replace(far_end.port, near_end.port)
        finally:
            process.terminate()
            await process.wait()


@pytest.mark.real_time
@pytest.mark.parametrize(
    "drives", [False, pytest.param(True, marks=[pytest.mark.long, pytest.mark.alone])]
)
@pytest.mark.parametrize("kind", ["tcp", "rtu"])
async def test_conformance_finds_what_the_server_cannot_do(
    kind: str, drives: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Those checks fail that the page names, no others; on RTU they are the last that drive."""
    # What is late on this machine is not a missing reply.
    for module in ("judge_client", "judged_exchange"):
        monkeypatch.setattr(f"era_haptics.lab.conformance.{module}.JUDGE_REPLY_TIMEOUT", 3.0)
    async with served(kind) as url:
        report = await asyncio.to_thread(judge, url, may_drive=lambda count: drives)
    checks = [(number, check) for number, check in of_kind(kind) if drives or not check.drives]
    assert [(result.number, result.check) for result in report.results] == checks
    failed = {
        result.check.name: result.reason for result in report.results if result.result == "failed"
    }
    skipped = {result.check.name for result in report.results if result.result == "skipped"}
    not_run = {result.check.name for result in report.results if result.result == "not_run"}
    names = {check.name for _, check in checks}
    assert set(failed) - BY_MACHINE == names & FAILED, failed
    assert skipped - BY_MACHINE == names & SKIPPED - not_run
    # It does not reply behind a request of another function, so that none can see it silent.
    assert bool(not_run) == (drives and kind == "rtu")


AT_HOME = ("era-sound-server", "era-soft-amp", "era-plate")
"""In the order in which they start."""
MAX_EXPOSURE = 2.0
"""On systemd's scale from 0 to 10, where `OK` ends at 4.9."""
MAX_EXPOSURE_AT_HOME = 6.3
"""Without what needs privileges or namespaces of the manager: capabilities and views of files."""
REAL_TIME = (
    *("sched_setscheduler", "mlockall", "setpriority", "ioctl", "memfd_create"),
    *("timer_create", "timer_settime"),
)
"""What a sound server and its clients call."""


def exposure(program: str, unit: Path, *options: str) -> float:
    """What systemd rates a unit."""
    judged = subprocess.run(
        [program, "security", "--offline=true", "--no-pager", *options, unit],
        capture_output=True,
        text=True,
        env=os.environ | {"XDG_RUNTIME_DIR": str(unit.parent)},
    )
    match = re.search(rf"Overall exposure level for {unit.name}: ([\d.]+)", judged.stdout)
    assert match is not None, judged.stderr
    return float(match[1])


def allows(program: str, unit: str, call: str) -> bool:
    """Whether the filters of a unit leave a system call, by systemd's own sets."""
    is_allowed = False
    for is_denied, names in re.findall(r"^SystemCallFilter=(~?)(.*)$", unit, re.MULTILINE):
        calls = names.split()
        for name in calls:  # of sets within sets, too
            if name.startswith("@"):
                command = [program, "syscall-filter", "--no-pager", name]
                listed = subprocess.run(command, capture_output=True, text=True)
                within = {line.strip() for line in listed.stdout.splitlines()[1:]}
                calls += within - {*calls}
        if call in calls:
            is_allowed = not is_denied
    return is_allowed


@pytest.mark.parametrize("is_allowed", [False, True])
def test_unit_is_valid_and_hardened(tmp_path: Path, is_allowed: bool) -> None:
    """systemd accepts every line and rates the exposure as low, devices allowed or not."""
    program = installed_program("systemd-analyze", package="systemd")
    text = (UNITS / "era-haptics.service").read_text("utf-8")
    if is_allowed:
        drop_in = (UNITS / "devices.conf").read_text("utf-8")
        commented = re.findall(r"^#(\w+=.*\n)", drop_in, re.MULTILINE)
        assert {"DeviceAllow=char-ttyUSB rw\n", "DeviceAllow=char-input r\n"} < set(commented)
        text = text.replace("[Install]", f"{''.join(commented)}[Install]")
    unit = tmp_path / "era-haptics.service"
    unit.write_text(text.replace("/opt/era-haptics/bin/era", sys.executable), encoding="utf-8")
    verified = subprocess.run([program, "verify", unit], capture_output=True, text=True)
    assert (verified.returncode, verified.stderr) == (0, "")
    assert exposure(program, unit) <= MAX_EXPOSURE


def test_units_at_home_are_valid_and_start_one_after_the_other(tmp_path: Path) -> None:
    """systemd accepts them as a user's; each wants and follows the one before it.

    systemd restarts the amplifier, and kills it if it stalls. The link is that of the rig; the card
    has an output for each exciter, an input for the sensor and one for the cable.
    """
    program = installed_program("systemd-analyze", package="systemd")
    texts = {}
    for name in AT_HOME:
        texts[name] = (WEEKEND / f"{name}.service").read_text("utf-8")
        text = re.sub(r"ExecStart=\S+", f"ExecStart={sys.executable}", texts[name])
        text = text.replace("%h/era-haptics/.venv/bin/era", sys.executable)
        (tmp_path / f"{name}.service").write_text(text.replace("%h/plate", "/"), "utf-8")
    verified = subprocess.run(
        [program, "--user", "verify", *tmp_path.iterdir()],
        capture_output=True,
        text=True,
        env=os.environ | {"XDG_RUNTIME_DIR": str(tmp_path), "SYSTEMD_UNIT_PATH": f"{tmp_path}:"},
    )
    assert (verified.returncode, verified.stderr) == (0, "")
    for name in AT_HOME:
        assert exposure(program, tmp_path / f"{name}.service", "--user") <= MAX_EXPOSURE_AT_HOME
        if name != "era-plate":
            assert "RestrictRealtime" not in texts[name]
            assert "@resources" not in texts[name]
            for call in REAL_TIME:
                assert allows(program, texts[name], call), (name, call)
    for predecessor, name in pairwise(AT_HOME):
        for key in ("Wants", "After"):
            assert f"\n{key}={predecessor}.service\n" in texts[name]
    rig = yaml.safe_load((WEEKEND / "rig.yaml").read_text("utf-8"))
    (amplifier,) = rig["amplifiers"].values()
    (link,) = re.findall(r"--link (\S+)", texts["era-soft-amp"])
    assert amplifier["url"] == f"serial://{link}"
    outputs, inputs = map(int, re.findall(r"--(?:out|in)channels (\d+)", texts["era-sound-server"]))
    assert (outputs, inputs) == (len(rig["eras"]), 2)
    assert f"--channels {len(rig['eras'])} " in texts["era-soft-amp"]
    for line in ("Type=notify", "Restart=always", "WatchdogSec=500ms", "WatchdogSignal=SIGKILL"):
        assert f"\n{line}\n" in texts["era-soft-amp"]


PAGES = ROOT / "docs" / "how-to"
PIP = ROOT / "tests" / "support" / "processes/built_pip.py"
NAMES = [
    "a-plate-for-a-weekend",
    "bring-your-own-method",
    "drive-a-signal-generator",
    "design-a-layout",
    "play-content",
    "plug-ins",
    "your-own-application",
]
WITH_CONFORMANCE = ["write-an-amplifier"]
"""It runs the whole of it."""
WITHOUT_CODE = ["design-a-plate", "measure-your-plate"]
"""Commands alone, without a file of the examples."""
SHORT = "plug-ins"
"""Executed by every run of the tests; the others by `make test-long`, and when they change."""


@pytest.fixture(scope="session")
def installed(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with all example plug-ins, built by pip without a package index."""
    target = tmp_path_factory.mktemp("site")
    options = ["--no-deps", "--no-build-isolation", "--disable-pip-version-check", "--quiet"]
    subprocess.run(
        [sys.executable, "-m", "pip", "install", *options, "--target", target]
        + [str(path.parent) for path in PLUGINS.glob("*/pyproject.toml")],
        check=True,
    )
    return target


@pytest.mark.parametrize(
    "name",
    [
        pytest.param(name, marks=[] if name == SHORT else [pytest.mark.long, pytest.mark.alone])
        for name in [*NAMES, *WITH_CONFORMANCE, *WITHOUT_CODE]
    ],
)
def test_page_commands_print_what_is_shown(name: str, tmp_path: Path, installed: Path) -> None:
    """Commands, run in order, print the output on the page.

    In a checkout with examples and firmware alone; `pip` installs prebuilt packages.
    """
    steps, folder = read_steps(PAGES / f"{name}.md"), tmp_path / "checkout"
    assert sum(step.shown is not None for step in steps) >= 2
    for part in ("examples", "firmware"):
        shutil.copytree(ROOT / part, folder / part)
    with tempfile.TemporaryDirectory(prefix="era") as short:
        home = Path(short)
        site, programs = home / "site", home / "bin"
        programs.mkdir()
        words = [sys.executable, str(PIP), str(installed), str(site)]
        pip = programs / "pip"
        pip.write_text(f'#!/bin/sh\nexec {shlex.join(words)} "$@"\n', "utf-8")
        pip.chmod(0o755)
        with Reader(folder, home=home, programs=programs, site=site) as reader:
            for step in steps:
                reader.follow(step)


@pytest.mark.parametrize("name", [*NAMES, *WITH_CONFORMANCE])
def test_page_includes_code_from_files(name: str) -> None:
    """Page and file cannot differ."""
    text = (PAGES / f"{name}.md").read_text("utf-8")
    included = re.findall(r"^```\{literalinclude\} (\S+)$", text, re.MULTILINE)
    assert included
    assert [path for path in included if not (PAGES / path).is_file()] == []
    assert "```python" not in text


LIMITS = GuardLimits(20.0, 1000.0, 1.0)


@pytest.fixture
def address(monkeypatch: pytest.MonkeyPatch) -> Any:
    """The class of the example, which opens all URLs."""
    module = runpy.run_path(str(PLUGINS / "wire" / "unix_wire.py"))["UnixAddress"]
    monkeypatch.setattr(opening, "address_of", module)
    return module


@asynccontextmanager
async def served_socket(path: Path) -> AsyncIterator[asyncio.Server]:
    """Two amplifiers at a socket, of which the server hears one host."""
    far = {number: SimulatedAmplifier(str(number), channels=1) for number in (1, 2)}
    loop = asyncio.get_running_loop()
    ended = asyncio.Event()

    async def serve(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        end = SerialAmplifiers(far, writer.write)
        while data := await reader.read(4096):
            end.receive(data, loop.time())
            if b"hang up" in data:
                break
        writer.close()
        ended.set()

    server = await asyncio.start_unix_server(serve, path)
    try:
        yield server
    finally:
        server.close()
        await ended.wait()
        await asyncio.sleep(0)


@pytest.mark.real_time
@pytest.mark.usefixtures("unhurried")
async def test_group_plays_behind_a_socket_until_it_is_closed(address: Any, tmp_path: Path) -> None:
    """Two amplifiers on one line, played by one commit, silent after a stop; then it is lost."""
    path = tmp_path / "line.sock"
    async with served_socket(path):
        lines = Lines()
        amplifiers = dict[str, Amplifier]()
        for name in ("1", "2"):
            url = f"example-unix://{path}#{name}"
            amplifiers[name] = await lines.amplifier(url, LIMITS, name=name)
        group = Group(amplifiers)
        await group.open()
        await group.arm()
        layers = [AmplifierLayer(0, (AmplifierTone(0, 100.0, 0.5),), 0.0)]
        await group.apply(dict.fromkeys(amplifiers, layers))
        statuses = [await amplifier.read_status() for amplifier in amplifiers.values()]
        assert [status["levels"] for status in statuses] == [[5000], [5000]]
        outcomes = await group.stop()
        confirmed = {name: outcome.is_confirmed for name, outcome in outcomes.items()}
        assert confirmed == {"1": True, "2": True}
        amplifiers["1"].line._port.write(b"hang up")
        async with asyncio.timeout(60.0):
            with pytest.raises(LinkError, match="was lost"):
                await read_for_ever(amplifiers["2"])
        await lines.close()


async def read_for_ever(amplifier: Any) -> None:
    """Read the status until an error."""
    while True:
        await amplifier.read_status()


async def test_url_and_socket_must_be_there(address: Any, tmp_path: Path) -> None:
    """An address that cannot be, a path that is none."""
    for url in ("example-unix://host/x", "example-unix:///x#300", "example-unix:///", "x:///y?z"):
        with pytest.raises(CommandError):
            address(url)
    with pytest.raises(LinkError, match="no connection"):
        await Lines().amplifier(f"example-unix://{tmp_path / 'none'}", LIMITS, name="a")


SOURCE = ROOT / "examples" / "smallest_amplifier" / "amplifier.c"
BUILD = "-std=c11 -D_GNU_SOURCE -Wall -Wextra -Werror -O1 -fsanitize=undefined -shared -fPIC"
NOT_IN_SMALLEST = {
    *("sensors", "steps_as_stated", "limited", "measured", "readings", "addresses", "mark"),
}


class SmallestEnd:
    """The program as a library, the far end of a serial line."""

    def __init__(self, library: Path, send: Callable[[bytes], None]) -> None:
        self._library, self._send = ctypes.CDLL(str(library)), send
        self._library.receive.argtypes = [ctypes.c_char_p, ctypes.c_int, ctypes.c_double]
        self._sent = ctypes.create_string_buffer(1 << 16)
        self._library.begin()

    def receive(self, data: bytes, now: float) -> None:
        """Take bytes from the host at a time [s]."""
        self._library.receive(data, len(data), now)
        if count := self._library.sent_since(self._sent):
            self._send(self._sent.raw[:count])

    def tick(self, now: float) -> None:
        """Let happen what is due by itself."""
        self.receive(b"", now)


@pytest.fixture(scope="module")
def compiled(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The program as a library whose time is that of its caller."""
    library = tmp_path_factory.mktemp("smallest") / "moved.so"
    compiler = installed_program("cc", package="gcc")
    command = [compiler, *BUILD.split(), f"-I{SOURCE.parent}", "-o", library]
    command += [ROOT / "tests" / "support" / "moved_smallest.c", "-lm"]
    subprocess.run(command, check=True)
    return library


@pytest.fixture
def library(tmp_path: Path, compiled: Path) -> Path:
    """A copy of it, which has variables of its own."""
    return shutil.copy(compiled, tmp_path / "moved.so")


SOME_CHECKS = (
    "every_channel",
    "ramps",
    "stop",
    "watchdog",
    "achieved",
    "voices",
    "kept_phase",
    "phases",
)


@pytest.mark.parametrize(
    ("level", "names"),
    [
        (0.2, SOME_CHECKS),
        *(pytest.param(result, (), marks=pytest.mark.long) for result in (0.2, 0.9)),
    ],
)
def test_conformance_on_a_clock_that_is_moved(
    level: float, names: tuple[str, ...], library: Path
) -> None:
    """All checks pass, where time is that of the test, and its sums of layers are limited."""
    results = judged("serial", names, level=level, far=partial(SmallestEnd, library))
    failed = [
        f"{result.check.name}: {result.reason}" for result in results if result.result == "failed"
    ]
    assert not failed, failed[0]
    skipped = {result.check.name for result in results if result.result == "skipped"}
    lacking = NOT_IN_SMALLEST if level < 0.5 else NOT_IN_SMALLEST - {"limited"}
    assert skipped == lacking & {result.check.name for result in results}


@pytest.mark.parametrize(
    ("frequency", "clock", "angle"),
    [(2200, 0x0010_0000, 193.359375), (2200, 0xF000_0000, 180), (5010, 0x1234_5678, 96)],
)
def test_samples_have_the_angles_of_the_page(
    frequency: int, clock: int, angle: float, library: Path
) -> None:
    """A tone of level 0.8 at 30° plays 0.8 · sin(angle + 30°), by a clock shifted and steered."""
    far = SmallestEnd(library, lambda _: None)
    ahead, rate = 1000, 10_000  # steps of shift that the clock has yet to run, 1000 ppm faster
    tone = (1, 0, 0, 0, frequency, 8000, 3000)  # layer 0 with one command, along a ramp of 0
    shift = ((clock >> 16) - ahead) % 65536
    for kind, words in ((3, (7, 2000, shift)), (12, (7, rate)), (5, (7, 1, 1 << 1 | 1, *tone))):
        far.receive(encode_frame(Frame(kind, 1, kind, b"", 4), words), 0)
    sample_of = ctypes.CDLL(str(library)).sample_of
    sample_of.argtypes, sample_of.restype = [ctypes.c_int, ctypes.c_double], ctypes.c_double
    time = ((ahead << 16) + clock % 65536) * 20 / 2**32 / (1 + rate * 1e-7)
    expected = 0.8 * math.sin(math.radians(angle + 30))
    assert sample_of(0, time) == pytest.approx(expected, abs=2e-5)


@pytest.mark.real_time
def test_program_serves_a_pseudo_terminal_and_leaves_the_users_alone(tmp_path: Path) -> None:
    """Its URL is printed, and a host finds it there; without an argument it says what it takes."""
    program = tmp_path / "amplifier"
    build = [installed_program("cc", package="gcc"), "-o", program, SOURCE, "-lm"]
    subprocess.run(build, check=True)
    bare = subprocess.run([program], capture_output=True, text=True, check=False)
    assert (bare.returncode, bare.stdout) == (2, "")
    assert bare.stderr == "usage: amplifier TTY | --pty\n"
    with subprocess.Popen([program, "--pty"], stdout=subprocess.PIPE, text=True) as running:
        url = running.stdout.readline().strip()
        assert asyncio.run(identify_amplifier(url))["serial_number"] == "SMALLEST-1"
        running.kill()


BUTTON = ROOT / "examples" / "javascript" / "button.mjs"
TARGET, QUIET = "0.08,0.06", "0.22,0.16"

PAGE = "controller/gateway/page/connection.js"

MEMBERS = """
    const [name] = process.argv.slice(1);
    const found = await import(name);
    const of = (made) => Object.getOwnPropertyNames(made ?? {});
    const members = Object.entries(found).map(([name, made]) =>
        [name, [...of(made), ...of(made.prototype)]]);
    console.log(JSON.stringify(Object.fromEntries(members)));
"""


@pytest.fixture(autouse=True)
def resting(monkeypatch: pytest.MonkeyPatch) -> None:
    """Fingers that stay until they lift: a busy machine may repeat their frames too late."""
    monkeypatch.setattr("controller.sources.touch.CONTACT_TIMEOUT", 60.0)


async def started(
    bench: DaemonBench | None, *places: str, program: Path = BUTTON
) -> asyncio.subprocess.Process:
    """The program with fingers at places, at a daemon if there is one."""
    socket = "nosuch.sock" if bench is None else str(bench.socket)
    return await asyncio.create_subprocess_exec(
        installed_program("node", "nodejs", package="nodejs"),
        str(program),
        *places,
        stdout=asyncio.subprocess.PIPE,
        stderr=asyncio.subprocess.PIPE,
        env={**os.environ, "ERA_HAPTICS_SOCKET": socket},
    )


async def ended(process: asyncio.subprocess.Process) -> tuple[int | None, str, str]:
    """Its exit status and both outputs."""
    out, err = await asyncio.wait_for(process.communicate(), PATIENCE)
    return process.returncode, out.decode(), err.decode()


@pytest.mark.parametrize(
    "environment",
    [
        {},
        {"XDG_RUNTIME_DIR": "/run/somewhere"},
        {"XDG_RUNTIME_DIR": "/run/somewhere", "ERA_HAPTICS_SOCKET": "own.sock"},
    ],
    ids=["none", "runtime folder", "own socket"],
)
def test_javascript_client_finds_the_socket_that_the_commands_find(
    environment: dict[str, str],
) -> None:
    """The socket of `era status`, also on machines without a runtime folder of the user."""
    client = ROOT / "examples" / "javascript" / "era_client.mjs"
    program = f"import({json.dumps(str(client))}).then(m => console.log(m.defaultSocket()))"
    node = installed_program("node", "nodejs", package="nodejs")
    process = subprocess.run(
        [node, "-e", program],
        env={"PATH": os.environ["PATH"], **environment},
        capture_output=True,
        text=True,
        check=True,
    )
    expected = default_socket({"PATH": os.environ["PATH"], **environment})
    assert process.stdout.strip() == str(expected)


@pytest.mark.real_time
async def test_button_is_felt_and_ends_safely(tmp_path: Path) -> None:
    """Killed, it lifts its fingers: the daemon is silent once the connection has ended.

    Else it prints the contrast that the daemon promises, and leaves it disarmed. Ctrl-C ends it
    after a stop, which stays latched.
    """
    async with ready_daemon(tmp_path) as (bench, era):
        await era.subscribe("pattern", "silence")
        process = await started(bench, QUIET, TARGET)
        await next_event(era, "pattern")
        process.kill()
        await ended(process)
        await next_event(era, "silence")
        assert not (await era.status()).contacts
        await until_state(era, READY)
        process = await started(bench, QUIET, TARGET)
        pattern = (await next_event(era, "pattern")).data
        while len(pattern["contacts"]) < 2:
            pattern = (await next_event(era, "pattern")).data
        status, out, err = await ended(process)
        assert (status, err) == (0, "")
        (contrast,) = re.findall(r"felt contrast (\S+) dB", out)
        assert float(contrast) == pytest.approx(pattern["predicted_contrast_db"], abs=0.05)
        assert await until_state(era, READY) == READY
        assert not (await era.status()).contacts
        process = await started(bench, QUIET, TARGET)
        await until_state(era, ENABLED)
        process.send_signal(2)
        assert (await ended(process))[0] == 130
        await until_state(era, "QUICK_STOP_ACTIVE")
        assert not any(bench.far.summary().levels)


@pytest.mark.real_time
async def test_connection_is_made_again_with_topics_and_lease(tmp_path: Path) -> None:
    """It comes back armed, and renews its lease; another daemon has not given its lease.

    It has chosen a layout, and chooses it again; what is no number is refused before it is sent.
    """
    program = f"""
        import {{ EraClient }} from {json.dumps(str(BUTTON.with_name("era_client.mjs")))};
        const era = await EraClient.connect();
        era.on("state", ({{ new: state }}) => console.log(state));
        era.on("opened", () => era.layout("climate").then(
            ({{ layout }}) => console.log("opened", layout), () => {{}}));
        era.on("lost", ({{ message }}) => {{ console.log("lost", message); process.exit(0); }});
        await era.subscribe("state");
        await era.arm(60);
        for (const wrong of [era.strength("javascript", NaN), era.touch([[0, Infinity]])])
            await wrong.catch(({{ name, message }}) => console.log(name, message));
        const {{ layout }} = await era.layout("climate");
        console.log("armed on", layout);
    """
    (tmp_path / "kept.mjs").write_text(program, encoding="utf-8")
    (tmp_path / "layout.yaml").write_text("elsewhere: null\n", "utf-8")
    layouts = "layouts: {home: layout.yaml, climate: layout.yaml}\n"
    async with ready_daemon(tmp_path, layouts) as (bench, era):
        process = await started(bench, program=tmp_path / "kept.mjs")
        awaited = {  # in either order
            *(b"armed on climate\n", f"{ENABLED}\n".encode()),
            b"TypeError gain_db must be a finite number, got NaN\n",
            b"TypeError y_m must be a finite number, got Infinity\n",
        }
        while awaited:
            line = await asyncio.wait_for(process.stdout.readline(), PATIENCE)
            assert line, (await process.stderr.read()).decode()  # else the program has ended
            awaited.discard(line)
        for connection in list(bench.daemon.server.clients):
            connection.abort()
        async with asyncio.timeout(PATIENCE):
            lease_left = later = (await era.status()).lease_left_s
            while later is not None and later <= lease_left:  # until it is renewed
                lease_left = later
                await asyncio.sleep(0.05)
                later = (await era.status()).lease_left_s
        assert (await era.status()).armed_by == "javascript"
    async with ready_daemon(tmp_path) as (bench, era):
        *states, lost = (await ended(process))[1].splitlines()
        assert (await era.status()).armed_by is None
    assert states.count(ENABLED) == 1  # when it was connected again
    assert states.count("opened climate") == 1
    assert lost.startswith("lost ")


@pytest.mark.real_time
@pytest.mark.parametrize(
    ("place", "expected", "message"), [(TARGET, 1, "nosuch.sock"), ("0.1", 2, "X,Y [X,Y ...]")]
)
async def test_without_a_daemon_it_says_so(place: str, expected: int, message: str) -> None:
    """One line on standard error and its status; what is no place is refused before."""
    status, _, err = await ended(await started(None, place))
    assert status == expected
    assert message in err
    assert len(err.splitlines()) == 1


@pytest.mark.real_time
def test_package_is_installed_with_types_of_what_it_has(tmp_path: Path) -> None:
    """By npm without a network, else as npm does; every declared function and method is there."""
    node = installed_program("node", "nodejs", package="nodejs")
    source, user = tmp_path / "examples" / "javascript", tmp_path / "user"
    shutil.copytree(BUTTON.parent, source)
    (tmp_path / PAGE).parent.mkdir(parents=True)
    shutil.copy(ROOT / PAGE, tmp_path / PAGE)
    user.mkdir()
    package = json.loads((source / "package.json").read_text("utf-8"))
    installed = user / "node_modules" / "era-haptics"
    npm = shutil.which("npm")
    if npm is not None:
        for command in (
            "pack --silent",
            f"install --offline --prefix {user} ./era-haptics-{package['version']}.tgz",
        ):
            subprocess.run([npm, *command.split()], cwd=source, check=True, capture_output=True)
    else:
        subprocess.run(package["scripts"]["prepack"], cwd=source, check=True, shell=True)
        installed.mkdir(parents=True)
        for path in [
            path for pattern in (*package["files"], "package.json") for path in source.glob(pattern)
        ]:
            shutil.copy(path, installed)
    api = (installed / "api.d.ts").read_text("utf-8")
    for name, export in package["exports"].items():
        done = subprocess.run(
            [node, "--input-type=module", "-e", MEMBERS, f"era-haptics{name[1:]}"],
            cwd=user,
            check=True,
            capture_output=True,
            text=True,
        )
        has = json.loads(done.stdout)
        types = (installed / export["types"]).read_text("utf-8")
        assert set(re.findall(r"^export (?:class|function) (\w+)", types, re.M)) == has.keys()
        for class_name, body in re.findall(
            r"^export class (\w+).*?\{\n(.*?)^\}", types, re.M | re.S
        ):
            methods = set(re.findall(r"^  (?:static )?(\w+)[<(]", body, re.M))
            assert methods - {"constructor", "on"} <= set(has[class_name])
        exported = re.findall(r"^export (?:type|interface) (\w+)", api, re.M)
        for used in re.findall(r"import type \{(.*?)\} from \"./api.js\"", types):
            assert set(re.findall(r"\w+", used)) <= set(exported)

"""Rigs that are checked, identified and followed on a wire, and applications on top of them.

`era rig check --url` and `identify` run as typed beside a plate in virtual time; a daemon follows
its plate by an estimator, a process of its own; a page in a real browser comes back after losses.
"""

import asyncio
import functools
import json
import math
import os
import selectors
import signal
import subprocess
import sys
import threading
from collections.abc import AsyncIterator, Callable, Coroutine
from contextlib import ExitStack, asynccontextmanager, suppress
from dataclasses import dataclass, replace
from functools import partial
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any, ParamSpec, TypeVar

import numpy as np
import pytest
from typer.testing import CliRunner, Result

from cases import shortly
from controller.api.client import AsyncClient, Client
from controller.api.methods import StateEvent
from controller.api.schema import LearningSummary
from controller.cli.commands import app
from controller.daemon.daemon import Daemon
from controller.demo.recorder import FingerVibration, steady_contrast_db
from controller.learning import learning as learning_module
from controller.learning.learned_table import load_learned
from controller.learning.worker import Worker
from controller.process.daemon_process import SocketLock
from drivers.errors import CommandError, LinkError
from examples.make_measured import record_responses, scanning_grid
from kit.clock import VirtualLoop, run_virtual
from kit.plates import write_rig
from kit.wires import WIRES, FarSide, far_side
from model.errors import InputError
from model.estimate.measurement import write_responses_csv, write_responses_uff
from model.rig.rig import Rig
from model.rig.rig_file import example_rig_path, load_rig
from model.structure.plate import Plate
from model.table.table_file import build_table
from processes.daemons import PATIENCE, daemon_at, far_end, ready
from processes.gateways import (
    TOKEN,
    Page,
    ScriptedDaemon,
    gateway_process,
    open_browser,
    real_daemon,
    wait_for,
    wait_for_state,
)
from registry import threads
from sim.amplifier.simulated_amplifier import SimulatedAmplifier
from sim.plant.fingers import Accelerometer

Typed = Callable[..., Result]
PORT = "serial:///dev/memory0?baud=921600"
"""Where the line is."""


@pytest.fixture
def typed(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Typed:
    """A command of `era rig` for the example's file, on this plate; raises the command's error."""
    write_rig(tmp_path / "rig.yaml", mesh="auto")

    def run(command: str, *options: str, on: Rig, file: str = "rig.yaml") -> Result:
        async def beside(main: Coroutine[Any, Any, Any]) -> Any:
            async with far_side(WIRES["serial"], on):
                return await main

        monkeypatch.setattr(asyncio, "run", lambda main: run_virtual(beside(main)))
        result = CliRunner().invoke(app, ["rig", command, str(tmp_path / file), *options])
        if result.exception is not None and not isinstance(result.exception, SystemExit):
            raise result.exception
        return result

    return run


def _long(name: str, *values: Any) -> Any:
    return pytest.param(*values, id=name, marks=pytest.mark.long)


PLATE = load_rig(example_rig_path())
"""The plate of the example's file."""


def with_first(**changes: Any) -> Rig:
    """That plate with another first ERA."""
    first, *others = PLATE.eras
    return replace(PLATE, eras=(replace(first, **changes), *others))


STROKE, WIRING = PLATE.eras[0].stroke, PLATE.wiring
EXCHANGED = replace(PLATE, wiring={**WIRING, "SW": WIRING["SE"], "SE": WIRING["SW"]})
THINNER = replace(PLATE, plate=replace(PLATE.plate, thickness=0.9 * PLATE.plate.thickness))


def test_plate_of_the_file_is_well(typed: Typed) -> None:
    """By four sensors at its ERAs; keys of the check and of the measurement."""
    result = typed("check", "--url", PORT, "--yes", "--json", on=PLATE)
    told = json.loads(result.stdout)
    assert result.exit_code == 0
    assert told["wiring_matches"]
    assert told["plate"]["matches"]
    assert [each["era"] for each in told["sensors"]] == ["SW", "SE", "NE", "NW"]
    assert told["responses"] == 28 * 4 * 4
    assert told["measure_time_s"] < 40


@pytest.mark.parametrize(
    ("real", "verdicts", "plate_matches"),
    [
        _long("dead", with_first(stroke=1e-6 * STROKE), ["dead", "well", "well", "well"], True),
        _long("weak", with_first(stroke=0.5 * STROKE), ["weak", "well", "well", "well"], True),
        pytest.param(
            with_first(gains=((100.0, 1.0, math.pi),)),
            ["inverted", "well", "well", "well"],
            True,
            id="inverted",
        ),
        # Thinner as far as sheets tell of its modulus; the sensors of an exchanged ERA go with it.
        pytest.param(THINNER, ["well"] * 4, True, id="thinner"),
        _long("exchanged", EXCHANGED, ["well"] * 4, False),
    ],
)
def test_faults_of_wiring_and_plate_are_told(
    typed: Typed, real: Rig, verdicts: list[str], plate_matches: bool
) -> None:
    """Exit status 1, and the verdict of each channel; a thinner plate by the promises it misses.

    Its modulus stands for the square of its thickness.
    """
    result = typed("check", "--url", PORT, "--yes", "--json", on=real)
    told = json.loads(result.stdout)
    assert result.exit_code == 1
    assert [each["states"] for each in told["channels"]] == [[verdict] for verdict in verdicts]
    assert told["wiring_matches"] == (verdicts == ["well"] * 4)
    assert told["plate"]["matches"] == plate_matches
    if real is THINNER:
        assert told["plate"]["changes"]["modulus"] == pytest.approx(0.9**2 - 1, abs=0.03)
        assert told["plate"]["kept_share"] < 0.5


def test_amplifiers_that_cannot_measure_are_named(
    typed: Typed, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Those of a daemon that holds its socket, and whose file names the rig, are refused.

    One that is not there and one without sensors by port or name, before anything plays; a plate
    whose first tones, played last again, differ, at the end.
    """
    (tmp_path / "daemon.yaml").write_text("rig: rig.yaml\nsocket: d.sock\n")
    check = partial(typed, "check", "--yes", "--url")
    lock = SocketLock(tmp_path / "d.sock")
    with pytest.raises(InputError, match="daemon is running"):
        check(PORT, on=PLATE, file="daemon.yaml")
    lock.release()
    assert check(PORT, on=PLATE, file="daemon.yaml").exit_code == 0
    with pytest.raises(LinkError, match="/dev/nowhere"):
        check("serial:///dev/nowhere?baud=921600", on=PLATE)
    with monkeypatch.context() as patch:
        patch.setattr("model.estimate.measurement.DRIFTED", 1e-9)
        with pytest.raises(InputError, match="at the end"):
            check(PORT, on=PLATE)
    monkeypatch.setattr(SimulatedAmplifier, "attach", lambda amplifier, sensing: None)
    with pytest.raises(CommandError, match=r"main.*sensors"):
        check(PORT, on=PLATE)


@pytest.mark.long
def test_rig_is_written_with_the_plate_that_is_there(
    tmp_path: Path, typed: Typed, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The spring that is softer, with less uncertainty, in a file that reads back; keys of JSON.

    Named by a daemon's file. A plate that is not explained ends with exit status 1, nothing is
    promised, and what was at the output stays.
    """
    softer = with_first(stiffness=0.88 * PLATE.eras[0].stiffness)
    truth = replace(softer, plate=replace(PLATE.plate, thickness=0.985 * PLATE.plate.thickness))
    new = tmp_path / "rig2.yaml"
    (tmp_path / "daemon.yaml").write_text("rig: rig.yaml\nsocket: d.sock\n")
    options = ("--url", PORT, "-o", str(new), "--yes", "--quick", "--json")
    result = typed("identify", *options, on=truth, file="daemon.yaml")
    told = json.loads(result.stdout)
    assert result.exit_code == 0
    assert told["explained"]
    assert told["files"] == [str(new)]
    assert told["measure_time_s"] < 10
    assert [each["era"] for each in told["sensors"]] == ["SW", "SE", "NE", "NW"]
    (spring,) = (each for each in told["parameters"] if each["name"] == "stiffness SW")
    assert abs(spring["difference"] + 12) < 3 * spring["standard_error"] < 6
    for each in told["expected_contrast"]:
        assert each["before_db"] < each["after_db"]
    found = load_rig(new)
    assert found.eras[0].stiffness == pytest.approx(truth.eras[0].stiffness, rel=0.03)
    assert found.uncertainty.stiffness < load_rig(tmp_path / "rig.yaml").uncertainty.stiffness / 3
    written = {key: told["uncertainty"][key] for key in ("stiffness", "field", "common_gain")}
    assert written == pytest.approx(
        {key: getattr(found.uncertainty, key) for key in written}, rel=1e-4
    )
    assert "identified in place" in (before := new.read_text("utf-8"))
    monkeypatch.setattr("model.estimate.identify.MAX_CHI2", 1e-3)
    result = typed("identify", *options, on=truth)
    told = json.loads(result.stdout)
    assert result.exit_code == 1
    assert (told["explained"], told["expected_contrast"], told["files"]) == (False, [], [])
    assert new.read_text("utf-8") == before


@pytest.mark.parametrize("command", [["check"], ["identify", "-o", "rig2.yaml"]])
def test_plate_with_a_part_that_does_not_scale_is_refused_before_it_is_measured(
    tmp_path: Path, typed: Typed, monkeypatch: pytest.MonkeyPatch, command: list[str]
) -> None:
    """Before a port is opened, where none is; also of a known thickness, which would not help."""
    monkeypatch.setattr(Plate.__dataclass_fields__["loss_exponent"], "metadata", {})
    known = "uncertainty: {thickness: 0}\nplate:\n  loss_exponent: 0.2\n"
    write_rig(tmp_path / "rig.yaml", ("plate:\n", known), mesh="auto")
    with pytest.raises(InputError, match=r"^plate\.loss_exponent: (?!.*set unc).*era rig identify"):
        typed(*command, "--url", "serial:///dev/none", "--yes", on=PLATE)


@pytest.mark.parametrize("ending", shortly(["csv", "uff"], ["uff"]))
def test_responses_of_a_real_plate_are_read_from_a_file(tmp_path: Path, ending: str) -> None:
    """Measured by a modal test in time, two plugs exchanged: the file's names are the rig's own."""
    rig = load_rig(write_rig(tmp_path / "rig.yaml", mesh="12x9"))
    sensors = scanning_grid(rig.plate, 3, 2, like=Accelerometer("", 0, 0, noise_density=5e-3))
    responses = record_responses(rig, sensors, np.linspace(61, 461, 6))
    swapped = replace(responses, values=responses.values[..., [0, 3, 2, 1]])
    file = tmp_path / f"measured.{ending}"
    write = write_responses_csv if ending == "csv" else write_responses_uff
    write(file, swapped, rig)
    result = CliRunner().invoke(
        app, ["rig", "check", str(tmp_path / "rig.yaml"), "--measured", str(file)]
    )
    assert result.exit_code == 1
    assert "SWAPPED: channel 1 of amplifier main (ERA SE in the rig) drives ERA NW" in result.stdout
    assert "PLATE" not in result.stdout
    assert "INVERTED" not in result.stdout


P = ParamSpec("P")
T = TypeVar("T")
Place = tuple[float, float]

IDENTIFIED = (
    "uncertainty: {gain: 1 %, phase_deg: 1, thickness: 0.2 %, stiffness: 1 %, damping: 1.05, "
    "fingertip: 0.5}\n"
)
"""Of a rig's file: what an identification leaves."""

_FELT = 0.2  # s
_REAL_WAIT = 0.05  # s; for a reply of the process


class BusyWorker(Worker):
    """A worker whose calls that have no reply yet are counted."""

    calls = 0

    async def call(self, limit: float, function: Callable[..., Any], *arguments: object) -> Any:
        """Return what a function returns in the process."""
        BusyWorker.calls += 1
        try:
            return await super().call(limit, function, *arguments)
        finally:
            BusyWorker.calls -= 1


@dataclass
class LearningBench:
    """A daemon that learns, its far end, and an armed client."""

    far: FarSide
    era: AsyncClient
    file: Path
    daemon: Daemon
    stands: bool = True

    @property
    def estimator(self) -> int:
        """Process number of the estimator."""
        return self.daemon.learning.worker.pid

    def is_estimating(self) -> bool:
        """Whether the estimator works, so that time is to stand still."""
        return self.stands and BusyWorker.calls > 0

    async def learning(self) -> LearningSummary:
        """What it has learned."""
        return (await self.era.status()).learning

    async def until(self, state: str, cause: str = "") -> LearningSummary:
        """Wait until it is in a state for a cause."""
        while True:
            found = await self.learning()
            if found.state == state and cause in found.cause:
                return found
            await asyncio.sleep(0.05)

    def change(self, **stiffness: float) -> None:
        """Multiply the stiffness of mounts, by ERA."""
        plate = replace(self.far.bench.imperfections.plate, stiffness=stiffness)
        self.far.bench.change_plate(plate, now=threads.now())

    async def touch(self, *places: Place, seconds: float = 1.2) -> float | None:
        """Fingers rest on the plate; contrast felt by the last one [dB], None if nothing plays."""
        named = {f"finger {number}": place for number, place in enumerate(places)}
        self.far.bench.place_fingers(named, now=threads.now())
        end = threads.now() + seconds
        while threads.now() < end:
            await self.era.touch(list(places))
            await asyncio.sleep(0.05)
        is_playing = any(self.far.summary().levels)
        self.far.bench.advance(threads.now())
        felt = self.far.bench.felt(threads.now() - _FELT, threads.now())
        *quiet, target = [
            FingerVibration(np.array(f.frequencies), f.amplitude, f.weights)
            for f in (felt[name] for name in named)
        ]
        await self.era.touch([])
        self.far.bench.place_fingers({}, now=threads.now())
        await asyncio.sleep(0.3)
        return steady_contrast_db(target, quiet) if is_playing else None

    async def patterns(self, count: int) -> LearningSummary:
        """Touch here and there until so many patterns more are estimated."""
        requested = (await self.learning()).estimates + count
        while (found := await self.learning()).estimates < requested:
            if found.readings < requested:
                await self.touch(*PAIRS[found.readings % len(PAIRS)])
            else:
                await asyncio.sleep(0.05)
        return found


@asynccontextmanager
async def learning_bench(
    folder: Path, *, uncertainty: str = IDENTIFIED, limit: float = 1e9
) -> AsyncIterator[LearningBench]:
    """A daemon that learns of a plate; uncertainty: in its rig's text, limit: for a pattern [s]."""
    changes = [("\nplate:", f"\n{uncertainty}plate:")]
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(learning_module, "Worker", BusyWorker)
        patch.setattr(learning_module, "START_LIMIT", 1e9)
        patch.setattr(learning_module, "ESTIMATE_LIMIT", limit)
        async with (
            far_end(folder, changes=changes) as far,
            daemon_at(far, folder, "learn: learned.npz\n", changes=changes, table=_table) as bench,
            await bench.client() as era,
        ):
            await ready(era)
            async with era.armed("test", lease_s=60):
                learning = LearningBench(far, era, folder / "learned.npz", bench.daemon)
                asyncio.get_running_loop().stands = learning.is_estimating
                try:
                    yield learning
                finally:
                    asyncio.get_running_loop().stands = bool


_table = partial(build_table, drive_mode="phased")


class _StandingLoop(VirtualLoop):
    """Virtual time that stands still while `stands` says so; sockets and pipes are served."""

    def __init__(self) -> None:
        super().__init__()
        self.stands: Callable[[], object] = bool
        jumping = self._selector.select

        def select(timeout: float | None = None) -> list[tuple[selectors.SelectorKey, int]]:
            if timeout != 0 and self.stands():
                return selectors.DefaultSelector.select(self._selector, _REAL_WAIT)
            return jumping(timeout)

        self._selector.select = select


def beside_a_process(test: Callable[P, Coroutine[object, object, T]]) -> Callable[P, T]:
    """Run a test in virtual time that passes while a real process works."""

    @functools.wraps(test)
    def run(*args: P.args, **kwargs: P.kwargs) -> T:
        with asyncio.Runner(loop_factory=_StandingLoop) as runner:
            return runner.run(test(*args, **kwargs))

    return run


PAIRS = (
    ((0.24, 0.06), (0.06, 0.17)),
    ((0.07, 0.06), (0.22, 0.17)),
    ((0.15, 0.19), (0.16, 0.05)),
)
PAIR = PAIRS[0]


@pytest.mark.long
@beside_a_process
async def test_loose_mount_is_named_and_its_contrast_comes_back(tmp_path: Path) -> None:
    """A mount 20 % softer is named; the same touches then get 3 dB more, and it is kept on disk."""
    async with learning_bench(tmp_path) as bench:
        await bench.until("following")
        await bench.patterns(6)
        bench.change(NE=0.8)
        before = await contrast(bench)
        while not (found := await bench.learning()).cause.startswith("the plate has changed"):
            await bench.patterns(1)
        assert "stiffness NE" in found.cause
        assert found.corrections > 0
        assert found.latency_ms.count > 0
        assert await contrast(bench) > before + 3
        while not bench.file.exists():  # written now and then
            await bench.patterns(1)
    table = _table(load_rig(bench.file.with_name("rig.yaml")))
    assert load_learned(bench.file, table=table.fingerprint)[0]["names"]


async def contrast(bench: LearningBench) -> float:
    """Median contrast of some touches [dB]."""
    found = [await bench.touch(*pair) for pair in PAIRS]
    return float(np.median([each for each in found if each is not None]))


@pytest.mark.long
@beside_a_process
async def test_touches_go_on_without_an_estimator(tmp_path: Path) -> None:
    """Killed, another follows; stopped, it is replaced; meanwhile and after touches play."""
    async with learning_bench(tmp_path, limit=3.0) as bench:
        await bench.until("following")
        first = bench.estimator
        os.kill(first, signal.SIGKILL)
        await bench.until("off")
        assert await bench.touch(*PAIR) is not None
        await bench.until("following")
        second = bench.estimator
        assert second != first
        bench.stands = False
        os.kill(second, signal.SIGSTOP)
        while (found := await bench.learning()).state == "following":
            assert await bench.touch(*PAIR) is not None
        assert "no reply within 3 s" in found.cause
        await bench.until("following")
        assert (await bench.learning()).restarts == 2


@beside_a_process
async def test_plate_that_was_not_measured_is_only_watched(tmp_path: Path) -> None:
    """With the thickness of a drawing, to 2 %, answers stay as built, and the cause says so."""
    async with learning_bench(tmp_path, uncertainty="uncertainty: {}\n") as bench:
        await bench.until("off", "thickness")
        assert (await bench.patterns(1)).corrections == 0


FOLDER = Path(__file__).parents[2] / "examples" / "application"
GATEWAY = "http://127.0.0.1:8137/"
SAID = "document.querySelector('#state').textContent"
FELT = "document.querySelector('#felt').textContent"


class Network:
    """Between browser and gateway: passes bytes on, or refuses connections while it is cut."""

    def __init__(self) -> None:
        self.port = self.target = 0  # target: port of the gateway
        self.is_cut = False
        self._writers: set[asyncio.StreamWriter] = set()

    @asynccontextmanager
    async def serving(self) -> AsyncIterator["Network"]:
        """Accept connections on a free port."""
        async with await asyncio.start_server(self._accept, "127.0.0.1", 0) as server:
            self.port = server.sockets[0].getsockname()[1]
            yield self
            self.cut()

    def cut(self) -> None:
        """Close all connections and refuse others."""
        self.is_cut = True
        for writer in self._writers:
            writer.transport.abort()

    async def _accept(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        self._writers.add(writer)
        with suppress(OSError):
            if not self.is_cut:
                back, forth = await asyncio.open_connection("127.0.0.1", self.target)
                self._writers.add(forth)
                await asyncio.gather(self._pass(reader, forth), self._pass(back, writer))
        writer.transport.abort()

    async def _pass(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        while data := await reader.read(1 << 16):
            writer.write(data)
        writer.close()


@asynccontextmanager
async def shown(tmp_path: Path) -> AsyncIterator[tuple[Page, Network, ExitStack, str]]:
    """A tab, the network, what ends at the end, and the origin of the page.

    The example's page comes from a server that is not the gateway but names it.
    """
    text = (FOLDER / "plate.html").read_text(encoding="utf-8")
    assert text.count(GATEWAY) == 1
    (folder := tmp_path / "page").mkdir()
    handler = partial(SimpleHTTPRequestHandler, directory=str(folder))
    async with (
        Network().serving() as network,
        open_browser(tmp_path / "profile") as browser,
        browser.open_page() as tab,
    ):
        own = text.replace(GATEWAY, f"http://127.0.0.1:{network.port}/")
        (folder / "plate.html").write_text(own, encoding="utf-8")
        with ThreadingHTTPServer(("127.0.0.1", 0), handler) as server, ExitStack() as ended:
            threading.Thread(target=server.serve_forever, daemon=True).start()
            ended.callback(server.shutdown)
            yield tab, network, ended, f"http://127.0.0.1:{server.server_port}"


def url(origin: str) -> str:
    """The page's address; it takes no gateway from a link."""
    return f"{origin}/plate.html?gateway=http://127.0.0.1:1/#{TOKEN}"


@pytest.mark.long
@pytest.mark.real_time
async def test_page_plays_and_comes_back_after_every_loss(tmp_path: Path) -> None:
    """Armed and touched over a cut network; after a new daemon and gateway it follows, disarmed,
    and says that its lease was lost.
    """
    async with shown(tmp_path) as (tab, network, ended, origin):

        async def until_said(start: str) -> None:
            await tab.until(SAID, lambda text: text.startswith(start))

        with gateway_process(tmp_path, tmp_path / "era.sock", "--allow-origin", origin) as gateway:
            network.target = gateway.port
            with real_daemon(tmp_path) as socket, Client.connect(socket) as era:
                wait_for_state(era, "READY_TO_SWITCH_ON")
                await tab.show(url(origin))
                await until_said("ready: ")
                await tab.click("#arm")
                await until_said("on: armed by 'my application'")
                x, y, width, height = await tab.evaluate(
                    "(({x, y, width, height}) => [x, y, width, height])"
                    "(document.querySelector('#plate').getBoundingClientRect())"
                )
                await tab.touch("touchStart", [(x + width / 4, y + height / 2)])
                await tab.until(FELT, lambda text: text.startswith("played by "))
                rig = era.hello("test").rig
                # what is felt may have expired on a busy machine, until the page repeats it
                (contact,) = await asyncio.to_thread(wait_for, lambda: era.status().contacts)
                assert contact.x_m == pytest.approx(rig.length_m / 4, abs=2e-3)
                assert contact.y_m == pytest.approx(rig.width_m / 2, abs=2e-3)
                network.cut()
                await until_said("no connection: ")
                network.is_cut = False
                await until_said("on: armed by 'my application'")
                await asyncio.to_thread(wait_for, lambda: (era.status().lease_left_s or 0) < 4.2)
                await asyncio.to_thread(wait_for, lambda: (era.status().lease_left_s or 0) > 4.5)
                await asyncio.to_thread(wait_for, lambda: len(era.status().contacts) == 1)
            await until_said("no connection: daemon")
            with real_daemon(tmp_path) as socket, Client.connect(socket) as era:
                await until_said("ready: ")
                await asyncio.to_thread(wait_for, lambda: len(era.status().contacts) == 1)
                await tab.until(FELT, lambda text: "lease" in text)
                assert era.status().armed_by is None
                gateway.terminate()
                await until_said("no connection: unreachable")
                again = ("--allow-origin", origin, "--listen", f"127.0.0.1:{gateway.port}")
                ended.enter_context(gateway_process(tmp_path, socket, *again))
                await until_said("ready: ")
                await tab.touch("touchEnd", [])
                await asyncio.to_thread(wait_for, lambda: not era.status().contacts)


@pytest.mark.real_time
def test_program_holds_fingers_and_prints_what_plays(tmp_path: Path) -> None:
    """It arms, plays and leaves the daemon disarmed."""
    with real_daemon(tmp_path) as socket, Client.connect(socket) as era:
        wait_for_state(era, "READY_TO_SWITCH_ON")
        done = subprocess.run(
            [sys.executable, FOLDER / "follow.py", "0.22,0.16", "0.08,0.06"],
            capture_output=True,
            text=True,
            check=False,
            env={**os.environ, "ERA_HAPTICS_SOCKET": str(socket)},
        )
        assert (done.returncode, done.stderr) == (0, "")
        assert "on: armed by 'follow'\n" in done.stdout
        assert "played by " in done.stdout
        assert era.status().state == "READY_TO_SWITCH_ON"
        assert not era.status().contacts


@pytest.mark.real_time
async def test_page_leaves_a_silent_network_and_repeats_no_arm(tmp_path: Path) -> None:
    """A pending arm is given up with the connection; the page subscribes anew.

    Its stop needs nothing that old browsers lack: without AbortSignal.timeout it goes both ways;
    where HTTP throws, over the WebSocket.
    """
    async with shown(tmp_path) as (tab, network, ended, origin):
        daemon = ended.enter_context(ScriptedDaemon(tmp_path))
        options = ("--allow-origin", origin)
        gateway = ended.enter_context(gateway_process(tmp_path, daemon.socket, *options))
        network.target = gateway.port
        await tab.show(url(origin))
        await tab.until(SAID, lambda text: text.startswith("ready: "))
        with daemon.holding():
            await tab.click("#arm")
            await asyncio.to_thread(wait_for, lambda: "arm" in daemon.methods)
            gateway.process.send_signal(signal.SIGSTOP)  # nothing comes, and nothing closes
            async with asyncio.timeout(PATIENCE / 6):
                await tab.until(SAID, lambda text: "gateway" in text or "no connection" in text)
            gateway.process.send_signal(signal.SIGCONT)
            await tab.until(SAID, lambda text: text.startswith("ready: "))
        cut = StateEvent(
            old="READY_TO_SWITCH_ON", new="FAULT", cause="a cable was cut", remedy=None, epoch=1
        )
        daemon.publish("state", cut)
        await tab.until(f"{SAID} === 'fault: a cable was cut'")
        assert daemon.methods.count("arm") == 1
        await tab.evaluate("delete AbortSignal.timeout")
        await tab.click("#stop")
        await asyncio.to_thread(wait_for, lambda: daemon.methods.count("stop") == 2)
        await tab.evaluate("window.fetch = () => { throw new Error('none'); }; undefined")
        await tab.click("#stop")
        await asyncio.to_thread(wait_for, lambda: daemon.methods.count("stop") == 3)


@pytest.mark.real_time
async def test_page_that_loses_its_user_lifts_and_disarms(tmp_path: Path) -> None:
    """Lifted once hidden, disarmed once left or closed, and by its button without a WebSocket.

    Before it has chosen a layout by the gateway's module.
    """
    async with shown(tmp_path) as (tab, network, ended, origin):
        (tmp_path / "layout.yaml").write_text("elsewhere: null\n", "utf-8")
        layouts = "layouts: {home: layout.yaml, climate: layout.yaml}\n"
        socket = ended.enter_context(real_daemon(tmp_path, layouts))
        era = ended.enter_context(Client.connect(socket))
        wait_for_state(era, "READY_TO_SWITCH_ON")
        era.subscribe("state")
        options = ("--allow-origin", origin)
        network.target = ended.enter_context(gateway_process(tmp_path, socket, *options)).port
        opened = (
            "(async () => {"
            f"  const {{ Connection }} = await import('http://127.0.0.1:{network.port}/connection.js');"
            "  await new Promise((opened) => {"
            f"    window.own = new Connection('{TOKEN}', ['state'], {{ opened }}); }});"
            "  await own.arm('own');"
            "})()"
        )

        async def until_disarmed() -> None:
            """By a call; a lease that runs out has another cause."""
            causes = (told.data["cause"] for told in era.events(timeout=PATIENCE))
            assert await asyncio.to_thread(any, (each.startswith("disarmed by") for each in causes))
            await asyncio.to_thread(wait_for_state, era, "READY_TO_SWITCH_ON")

        for end in ("own.socket.close(); own.disarm()", "own.close()"):
            await tab.show(url(origin))
            await tab.until(SAID, lambda text: text.startswith("ready: "))
            await tab.evaluate(opened)
            assert era.status().armed_by is not None
            assert (await tab.evaluate("own.layout('climate')"))["layout"] == "climate"
            await tab.evaluate(end)
            await until_disarmed()
        await tab.until("own.socket.readyState === WebSocket.CLOSED")
        await tab.click("#arm")
        await asyncio.to_thread(wait_for_state, era, "OPERATION_ENABLED")
        x, y = await tab.evaluate(
            "(({x, y}) => [x + 50, y + 50])"
            "(document.querySelector('#plate').getBoundingClientRect())"
        )
        await tab.touch("touchStart", [(x, y)])
        await asyncio.to_thread(wait_for, lambda: len(era.status().contacts) == 1)
        await tab.evaluate(
            "Object.defineProperty(document, 'hidden', { value: true });"
            "document.dispatchEvent(new Event('visibilitychange'))"
        )
        await asyncio.to_thread(wait_for, lambda: not era.status().contacts)
        await tab.call("Page.navigate", url="about:blank")
        await until_disarmed()

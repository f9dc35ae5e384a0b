"""Whole programmes with people at a plate: in virtual time, as processes, and on the desk.

Examples for several people and for many ERAs; a modal test that becomes a new rig; touches from the
panel to the wire; clients that flood and files that are damaged while the loop goes on; a sound
server that is killed; the Qt application; the desk without hardware. Short forms without a server
or a daemon are in tests/sim/soft_amp and tests/era_haptics/lab/measuring.
"""

import asyncio
import contextlib
import os
import pickle
import random
import signal
import subprocess
import sys
import time
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

import model
from benchmarks.latency.session import daemon_session, plain_session, taps
from cases import shortly
from controller.api.client import AsyncClient, Client
from controller.api.jsonrpc import RpcError
from controller.api.link import Unreachable
from controller.api.schema import ContactStatus
from controller.daemon.daemon import check_daemon
from controller.demo.demonstration import Scene, example_scenes, run_demo
from controller.effects.layout import load_layout
from controller.sources.tuio_capture import read_capture
from kit.clock import in_virtual_time, run_virtual
from kit.fingers import write_schedule
from model.errors import InputError
from model.rig.rig_file import load_rig
from model.table.table_file import build_table
from processes.daemons import (
    ENABLED,
    PATIENCE,
    PLACE,
    READY,
    STARTING,
    DaemonProcess,
    daemon_at,
    daemon_process,
    far_end,
    holding,
    loudness,
    next_event,
    play,
    playing_daemon,
    plays_on,
    ready,
    ready_daemon,
    run_era,
    until_state,
    write_daemon,
)
from processes.daemons import until as until_seen
from processes.desk import DEVICE, PLATE, Desk, desk, identified_errors, session
from processes.floods import flood
from processes.gateways import TOKEN, gateway_process, real_daemon, wait_for
from processes.jack_recorder import Capture
from processes.patient_daemon import RESTING, wait_long
from processes.sound_cards import SoftAmp, jack_server

EXAMPLES = Path(model.__file__).parents[1] / "examples"

ANY = (0.0, 500.0)
PEOPLE = {
    "car_display": {(0.15, 0.12): (60.0, 110.0), (0.38, 0.12): (180.0, 280.0)},
    "table": {(0.30, 0.26): ANY, (0.90, 0.26): ANY, (0.90, 0.54): ANY, (0.30, 0.54): ANY},
}
"""Where each person rests a finger, and the band [Hz] that the layout gives it."""


async def contacts_at_full_level(era: AsyncClient) -> list[ContactStatus]:
    """Wait until every finger feels a content at nearly its level of 20 dB SL; by their ids."""
    levels = [0.0]
    while min(levels, default=0.0) < 17:
        status = await era.status()
        levels = [contact.level_db_sl or 0.0 for contact in status.contacts]
    return sorted(status.contacts, key=lambda contact: contact.id)


@pytest.mark.real_time
@pytest.mark.alone
@pytest.mark.parametrize("name", shortly(PEOPLE, []))
async def test_everyone_at_an_example_feels_their_own(
    name: str, tmp_path: Path, table_cache: Path
) -> None:
    """`era daemon examples/NAME_daemon.yaml` as on its page.

    Each in the band of its region, at least 30 Hz apart, 6 dB and more above all others there. With
    nobody at the plate nothing plays.
    """
    process = await asyncio.create_subprocess_exec(
        *(*RESTING, "daemon", str(EXAMPLES / f"{name}_daemon.yaml")),
        env=os.environ | {"XDG_CACHE_HOME": str(table_cache), "XDG_RUNTIME_DIR": str(tmp_path)},
        stderr=asyncio.subprocess.DEVNULL,
    )
    socket, people = tmp_path / "era-haptics" / "daemon.sock", PEOPLE[name]
    try:
        await until_seen(lambda: socket.is_socket() or process.returncode, patience=STARTING)
        async with await AsyncClient.connect(socket, name="test", timeout=PATIENCE) as era:
            await ready(era)
            async with era.armed("test"):
                frequencies = []
                async with holding(era, *people), asyncio.timeout(PATIENCE):
                    contacts = await contacts_at_full_level(era)
                assert len(contacts) == len(people)
                for contact, (low, high) in zip(contacts, people.values(), strict=True):
                    assert contact.verdict in ("own", "mixed")
                    assert contact.promised_contrast_db > 6
                    assert low <= contact.frequency_hz <= high
                    frequencies.append(contact.frequency_hz)
                gaps = np.diff(sorted(frequencies))
                assert min(gaps) >= 30
                await era.subscribe("silence")
                await era.touch([])
                await next_event(era, "silence")
    finally:
        process.terminate()
        await process.wait()


COUNT, PLANTED = 10, 0.08  # s


@pytest.mark.long
@pytest.mark.alone
@pytest.mark.parametrize("is_two", [False, True])
async def test_time_of_every_touch_holds_a_delay_of_the_daemon(is_two: bool) -> None:
    """Each set that is counted answers its own touch; with two contents, the later of both.

    The daemon takes a time longer for every frame of the panel.
    """
    program = (sys.executable, "-m", "benchmarks.latency.planted", PLANTED)
    async with daemon_session("paper_plate", program=program, is_two=is_two) as session:
        measured = await taps(session, COUNT, is_two=is_two)
    assert measured.unanswered == 0
    assert measured.times.min() > PLANTED
    assert measured.times.min() > measured.wire > 0


@pytest.mark.long
@pytest.mark.alone
async def test_baseline_answers_every_touch() -> None:
    """Plain asyncio, which computes nothing, on the same line."""
    async with plain_session("paper_plate") as session:
        measured = await taps(session, COUNT)
    assert measured.unanswered == 0
    assert 0 < measured.times.min() < measured.times.max()


CHANNELS = 4
SERVER_BACK = 20.0  # s


@pytest.mark.long
@pytest.mark.alone
@pytest.mark.needs("jackd", "portaudio", "cc")
async def test_lost_server_is_a_fault_and_comes_back_disarmed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The daemon loses the amplifier; once server and amplifier are back, it waits for arm.

    The finger never leaves. A service manager would restart the amplifier; the test does.
    """
    wait_long(monkeypatch)
    name = f"gone{os.getpid()}"
    with jack_server(name, outputs=CHANNELS) as server:
        options = ("--device", "system, JACK", "--channels", str(CHANNELS))
        amp = _soft_amp(options, name, tmp_path)
        far = SimpleNamespace(urls={})
        change = ('main: {url: "sim://"}', f'main: {{url: "{amp.url}", full_level: output}}')
        async with (
            daemon_at(far, tmp_path, changes=(change,)) as daemon,
            await daemon.client() as era,
            holding(era, PLACE),
        ):
            await ready(era)
            await era.arm("test", lease_s=60)
            await _until_playing(era)
            server.process.kill()
            server.process.wait()
            await until_state(era, "FAULT", "COMM_LOST")
            assert not (await era.status()).drive
            ended = await asyncio.to_thread(amp.process.wait, SERVER_BACK)
            assert ended in {3, -signal.SIGKILL}  # by itself, or by the kernel
            amp.end()
            with jack_server(name, outputs=CHANNELS):
                amp = _soft_amp(options, name, tmp_path)
                await until_state(era, "FAULT", "COMM_LOST", READY)
                assert not (await era.status()).drive
                await ready(era)
                await era.arm("test", lease_s=60)
                await _until_playing(era)
                amp.end()


def _soft_amp(options: Sequence[str], server: str, folder: Path) -> SoftAmp:
    """Start it as soon as the server is up."""
    Capture(server, "looking", 1).close()
    environment = os.environ | {"JACK_DEFAULT_SERVER": server}
    link = ("--link", str(folder / "amp"))
    return SoftAmp(*options, *link, environment=environment, log=folder / "log")


async def _until_playing(era: AsyncClient) -> None:
    end = time.monotonic() + PATIENCE
    while not (await era.status()).drive:
        assert time.monotonic() < end
        await asyncio.sleep(0.01)


MAX_GROWTH = 64  # MiB; 32 clients with 256 KiB each to read, and as much to parse, are less


def resident(pid: int) -> float:
    """Return the resident memory of a process [MiB]."""
    with open(f"/proc/{pid}/statm", encoding="ascii") as stream:  # noqa: PTH123
        return int(stream.read().split()[1]) * 4096 / 2**20


async def stop_by_new_client(daemon: DaemonProcess) -> None:
    """Connect a new client and stop the daemon by it."""
    async with asyncio.timeout(PATIENCE):
        while True:
            try:
                async with await daemon.client() as new_client:
                    await new_client.stop()
                    break
            except (RpcError, Unreachable, ConnectionError):  # too many clients
                await asyncio.sleep(0.05)
    await until_seen(lambda: loudness(daemon.far) == 0)


@pytest.mark.long
@pytest.mark.alone
async def test_daemon_plays_on_with_idle_and_unreading_clients(tmp_path: Path) -> None:
    """With 2000 idle and 10 unreading ones memory is bounded, and a new client can stop it."""
    async with playing_daemon(tmp_path) as (daemon, era, journal):
        memory = resident(daemon.process.pid)
        async with (
            flood("unreading", daemon.socket, 10),
            flood("idle", daemon.socket, 2000) as idle,
        ):
            await plays_on("clients connecting", daemon, era, journal)
            assert int(await asyncio.wait_for(idle.stdout.readline(), 3 * PATIENCE)) == 2000
            await plays_on("2000 idle, 10 unreading", daemon, era, journal)
            await stop_by_new_client(daemon)
            assert resident(daemon.process.pid) - memory < MAX_GROWTH
        await play(era, daemon.far)


@pytest.mark.long
@pytest.mark.alone
async def test_stops_are_served_while_clients_connect_again_and_again(tmp_path: Path) -> None:
    """Of 25 new clients each, beside 2000 connections in a second, and of the command."""
    async with far_end(tmp_path) as far, daemon_process(tmp_path, far) as daemon:
        async with flood("again", daemon.socket, 200):
            served = 0
            for _ in range(25):
                with contextlib.suppress(RpcError, Unreachable):
                    async with await daemon.client() as era:
                        await era.stop()
                        served += 1
            status, _, problem = await run_era("stop", "--socket", daemon.socket)
        assert (served, status, problem) == (25, 0, "")


@pytest.mark.long
@pytest.mark.alone
@pytest.mark.parametrize("kind", ["garbage", "asking"])
async def test_daemon_plays_on_when_clients_flood(tmp_path: Path, kind: str) -> None:
    """With malformed or endless requests any client can stop it, and the log stays short."""
    async with playing_daemon(tmp_path) as (daemon, era, journal):
        memory = resident(daemon.process.pid)
        async with flood(kind, daemon.socket, 4), flood(kind, daemon.socket, 5):
            await plays_on(f"clients flood: {kind}", daemon, era, journal)
            await stop_by_new_client(daemon)
        await play(era, daemon.far)
        assert resident(daemon.process.pid) - memory < MAX_GROWTH
        assert not daemon.has_logged("Traceback")
        assert not daemon.has_logged("no json")
        assert len(daemon.log) < 200  # invalid requests do not fill the disk


MAX_TIME = 5.0  # s; expanded aliases would take minutes, and gigabytes


class Opened:
    """Runs a command when it is unpickled."""

    def __reduce__(self) -> tuple[object, tuple[str]]:
        return os.system, ("touch pickled",)


BOMB = "\n".join(
    ["a0: &a0 [x, x, x, x, x, x, x, x, x]"]
    + [f"a{n}: &a{n} [{', '.join([f'*a{n - 1}'] * 9)}]" for n in range(1, 12)]
)
LAYOUT = """effects: {hum: {kind: buzz}}
regions:
  pad: {rectangle: {start: [1 cm, 1 cm], end: [20 cm, 18 cm]}, on_press: hum}
"""

INVALID = [
    pytest.param(b"", "", id="empty"),
    pytest.param(pickle.dumps({"rig": Opened()}), "", id="pickle"),
    pytest.param(BOMB.encode(), ":1: a0: ", id="aliases"),
    pytest.param(b"x: !!python/object/apply:os.system ['touch pickled']\n", ":1: x: ", id="tag"),
    pytest.param(b"a: " + b"[" * 900, ":1: a", id="nested"),
    pytest.param(b"a: 1\n" + b"#" * (1 << 22), "", id="large"),
    pytest.param(b"a: 1\na: 2\n", ":2: a: ", id="duplicate key"),
    pytest.param(random.Random(5).randbytes(3000), "", id="noise"),
    pytest.param(None, "", id="endless device"),
]


@pytest.mark.parametrize("role", ["daemon.yaml", "rig.yaml", "layout.yaml"])
@pytest.mark.parametrize(("content", "place"), INVALID)
def test_daemon_refuses_files_that_are_no_plain_data(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, role: str, content: bytes | None, place: str
) -> None:
    """As configuration, rig or layout: with the file's name, at once and without executing it."""
    monkeypatch.chdir(tmp_path)
    path = write_daemon(tmp_path, {"main": "sim://"}, "layouts: {panel: layout.yaml}\n")
    (tmp_path / "layout.yaml").write_text(LAYOUT, encoding="utf-8")
    check_daemon(path)
    (tmp_path / role).unlink()
    if content is None:
        (tmp_path / role).symlink_to("/dev/zero")
    else:
        (tmp_path / role).write_bytes(content)
    begin = time.process_time()
    with pytest.raises(InputError) as caught:
        check_daemon(path)
    assert time.process_time() - begin < MAX_TIME
    assert f"{tmp_path / role}{place}" in str(caught.value)
    assert not (tmp_path / "pickled").exists()


@pytest.mark.parametrize("is_every_one", shortly([False, True], [False]))
@in_virtual_time
async def test_running_daemon_keeps_configuration_when_reload_is_invalid(
    tmp_path: Path, caplog: pytest.LogCaptureFixture, is_every_one: bool
) -> None:
    """Each invalid file: nothing is applied, not even valid changes beside it; it plays on."""
    layout, config = tmp_path / "layout.yaml", tmp_path / "daemon.yaml"
    layout.write_text(LAYOUT, encoding="utf-8")
    async with ready_daemon(tmp_path, "layouts: {panel: layout.yaml}\n") as (bench, era):
        await era.arm("test", lease_s=60)
        effects = await era.effects()
        async with holding(era, far=bench.far):
            good = config.read_text("utf-8")
            config.write_text(f"{good}dashboard: 127.0.0.1:1\n", encoding="utf-8")
            invalid = [case.values[0] for case in INVALID if case.values[0] is not None]
            invalid = invalid[:: 1 if is_every_one else 3]
            for content in invalid:
                layout.write_bytes(content)
                await bench.daemon.reload()
            rejected = [message for message in caplog.messages if "reload rejected" in message]
            assert len(rejected) == len(invalid)
            assert "reload failed" not in caplog.text
            assert await era.effects() == effects
            assert max(bench.far.summary().levels) > 0
        status = await era.status()
        assert status.state == ENABLED
        assert (status.lease_left_s or 0) > 5
    with pytest.raises(InputError, match=r"layout\.yaml"):
        check_daemon(config)


CHANNELS_OF = {"eight_eras": [4, 4], "car_display": [4, 4, 4], "table": [4, 4, 4, 4]}
SCHEDULE = ((1, 0.1, 0.9, 0.30, 0.35), (2, 0.15, 0.9, 0.80, 0.70))
"""Fingers: id, down and up [s], place in TUIO's coordinates; the second shall feel it."""


@pytest.mark.parametrize("name", shortly(CHANNELS_OF, ["eight_eras", "car_display"]))
def test_finger_feels_what_many_eras_promise(name: str, tmp_path: Path) -> None:
    """All ERAs on all amplifiers play, and the fingers feel at least the promised contrast.

    On the first plate that is drawn, level within 3 dB; by fields of the plate in time. The levels
    that its picture shows differ by the contrast in its title.
    """
    file = EXAMPLES / f"{name}.yaml"
    rig = load_rig(file)
    counts = Counter(wire.amplifier for wire in rig.wiring.values())
    assert [counts[amplifier] for amplifier in rig.amplifiers] == CHANNELS_OF[name]
    table = build_table(rig, frequencies=np.array([120.0, 160.0, 200.0]), drive_mode="phased")
    capture = read_capture(write_schedule(tmp_path / "touches.tuio", SCHEDULE, 1.0))
    scenes = [Scene(capture)]
    demo = run_demo(file, table, wire="sim", scenes=scenes, on_row=lambda row: None)
    *_, row = run_virtual(demo).rows
    assert row.drive.keys() == {era.name for era in rig.eras}
    x, y = SCHEDULE[1][3:]
    assert row.targets_m == [pytest.approx((x * rig.plate.length, (1 - y) * rig.plate.width))]
    assert row.steady
    assert row.measured_contrast_db >= row.promised_contrast_db > 6
    (quiet,) = row.quiet
    contrast = row.levels_db_sl[row.target_id] - row.levels_db_sl[quiet]
    assert contrast == pytest.approx(row.measured_contrast_db)
    assert row.measured_level_db_sl == pytest.approx(row.predicted_level_db_sl, abs=3)


def test_three_people_each_feel_their_own_content_while_one_slides_and_one_leaves() -> None:
    """In its band, and promised as its own; at least that on the first plate that is drawn.

    The one that slides by a third of the plate feels it where it rests at last, and the rows of
    all three are of that moment, with one set of figures.
    """
    file = EXAMPLES / "car_display.yaml"
    rig = load_rig(file)
    table = build_table(rig, frequencies=np.arange(70.0, 301.0, 10.0), drive_mode="phased")
    scene = example_scenes(rig)[-1]
    demo = run_demo(file, table, wire="sim", scenes=[scene], on_row=lambda row: None)
    rows = run_virtual(demo).rows
    slid, stayed, third = rows
    assert len(slid.fingers) == 3
    assert slid.fingers == stayed.fingers == third.fingers
    for row, finger in zip(rows, slid.fingers, strict=True):
        assert row.measured_contrast_db == finger.measured_contrast_db
        assert row.targets_m == [finger.at_m]
    assert slid.targets_m == [pytest.approx((0.15 * 0.53, 0.65 * 0.30), abs=0.008)]
    bands = [(70, 110), (180, 220), (250, 300)]
    for finger, (low, high) in zip(slid.fingers, bands, strict=True):
        assert low <= finger.frequency_hz <= high
        assert finger.verdict == "own"
        assert finger.measured_contrast_db >= finger.promised_contrast_db >= 12
        assert finger.measured_level_db_sl == pytest.approx(20.0, abs=3)
    for row in rows:
        assert row.steady
        assert row.as_json()["fingers"]


@pytest.mark.parametrize("name", CHANNELS_OF)
def test_layout_lies_on_its_plate(name: str) -> None:
    """Every control is where a finger can be, and no control covers the middle of another."""
    plate = load_rig(EXAMPLES / f"{name}.yaml").plate
    regions = load_layout(EXAMPLES / f"{name}_layout.yaml", plate).regions
    assert len(regions) >= 6
    for region in regions:
        x, y = region.shape.center
        assert 0 < x < plate.length
        assert 0 < y < plate.width
        assert [candidate.name for candidate in regions if candidate.shape.contains(x, y)] == [
            region.name
        ]


FOLDER = Path(__file__).parents[2] / "examples" / "application"

Until = Callable[[Callable[[], object]], None]


@pytest.fixture
def until(monkeypatch: pytest.MonkeyPatch) -> Until:
    """Wait for a condition of PySide6 without a screen.

    Its absence is a failure only where `make qt-test` installs it.
    """
    monkeypatch.setenv("QT_QPA_PLATFORM", "offscreen")
    monkeypatch.syspath_prepend(FOLDER)
    try:
        from PySide6.QtWidgets import QApplication
    except ImportError as error:
        reason = f"no PySide6 ({error}): make qt-test installs it, apt libegl1 and libgl1"
        if (Path(sys.prefix) / "installed-qt").exists():
            pytest.fail(reason)
        pytest.skip(reason)
    application = QApplication.instance() or QApplication([])

    def wait(condition: Callable[[], object]) -> None:
        def processed() -> object:
            application.processEvents()
            return condition()

        wait_for(processed)

    return wait


@pytest.mark.real_time
@pytest.mark.long
def test_application_plays_and_comes_back_after_every_loss(tmp_path: Path, until: Until) -> None:
    """By a mouse; after a new daemon, and a gateway that hangs, it follows and stays disarmed."""
    from PySide6.QtCore import QPoint, Qt
    from PySide6.QtTest import QTest
    from qt_plate import Plate, Window

    with gateway_process(tmp_path, tmp_path / "era.sock") as gateway:
        window = Window(Plate(gateway.url, TOKEN, ["state", "pattern", "silence"]))
        window.show()

        def until_said(start: str) -> None:
            until(lambda: window.state.text().startswith(start))

        button, at = Qt.MouseButton.LeftButton, QPoint(100, 150)  # of 400 by 300
        until_said("no connection: the daemon does not respond")
        with real_daemon(tmp_path) as socket, Client.connect(socket) as era:
            until_said("ready: ")
            QTest.mouseClick(window.arm, button)
            until_said("on: armed by 'my application'")
            until(lambda: era.status().state == "OPERATION_ENABLED")
            refused: list[str] = []
            window.plate.refused.connect(refused.append)
            QTest.mouseClick(window.arm, button)  # the lease is kept
            until(lambda: any(refusal.startswith("armed by") for refusal in refused))
            QTest.mousePress(window.surface, button, pos=at)
            until(lambda: window.felt.text().startswith("played by "))
            rig = era.hello("test").rig
            widgets: list[Any] = []
            until(lambda: widgets.extend(era.status().contacts) or widgets)  # repeated by its timer
            contact = widgets[0]
            assert contact.x_m == pytest.approx(rig.length_m / 4, abs=1e-3)
            assert contact.y_m == pytest.approx(rig.width_m / 2, abs=1e-3)
            until(lambda: (era.status().lease_left_s or 0) < 4.2)
            until(lambda: (era.status().lease_left_s or 0) > 4.5)
        until_said("no connection: ")
        with real_daemon(tmp_path) as socket, Client.connect(socket) as era:
            until_said("ready: ")
            until(lambda: len(era.status().contacts) == 1)
            assert era.status().armed_by is None
            gateway.process.send_signal(signal.SIGSTOP)
            until_said("no connection: ")
            gateway.process.send_signal(signal.SIGCONT)
            until_said("ready: ")
            QTest.mouseRelease(window.surface, button, pos=at)
            until(lambda: not era.status().contacts)
            QTest.mouseClick(window.stop, button)
            until_said("stopped: ")
            assert era.status().state == "QUICK_STOP_ACTIVE"


@pytest.mark.real_time
@pytest.mark.long
def test_application_without_its_user_or_connection_lifts_and_disarms(
    tmp_path: Path, until: Until
) -> None:
    """A hidden window, a closed one, and Disarm without a WebSocket; no lease runs out."""
    from PySide6.QtCore import QPoint, Qt
    from PySide6.QtTest import QTest
    from qt_plate import Plate, Window

    with (
        real_daemon(tmp_path) as socket,
        gateway_process(tmp_path, socket) as gateway,
        Client.connect(socket) as era,
    ):
        era.subscribe("state")
        window = Window(Plate(gateway.url, TOKEN, ["state", "pattern", "silence"]))
        button = Qt.MouseButton.LeftButton

        def disarm() -> None:
            window.plate.socket.abort()
            QTest.mouseClick(window.disarm, button)

        for leave in (window.hide, disarm, window.close):
            window.show()
            until(lambda: window.state.text().startswith("ready: "))
            QTest.mouseClick(window.arm, button)
            until(lambda: era.status().armed_by is not None)
            until(lambda: window.state.text().startswith("on: "))
            if leave is not disarm:
                QTest.mousePress(window.surface, button, pos=QPoint(100, 150))
                until(lambda: len(era.status().contacts) == 1)
            leave()
            until(lambda: era.status().armed_by is None and not era.status().contacts)
            causes = [event.data["cause"] for event in era.events(timeout=0.1)]
            assert "the arming lease was not renewed" not in causes
            QTest.mouseRelease(window.surface, button, pos=QPoint(100, 150))


SEED, DESK_MESH = 3, "6x4 Q3"


@pytest.fixture(scope="module")
def plate(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Desk]:
    """A plate behind a JACK server of its own."""
    with desk(tmp_path_factory.mktemp("desk"), seed=SEED, mesh=DESK_MESH) as running:
        yield running


@pytest.mark.long
@pytest.mark.alone
@pytest.mark.needs("jackd", "cc")
def test_identified_plate_is_the_one_on_the_desk(plate: Desk) -> None:
    """Few tones, through the command: what drives the plate, its springs, its places.

    A second plate of that name is refused: it would be measured in place of the first.
    """
    plate.run(
        "rig", "identify", "rig.yaml", "--device", DEVICE, "--sensors", "sensors.csv",
        "-o", "identified.yaml", "--frequencies", "61:481:60", "--yes",
    )  # fmt: skip
    rig = load_rig(plate.folder / "identified.yaml")
    limits = {"stiffness": 0.03, "place": 5e-4, "gain": 0.02, "phase": np.radians(2)}
    errors = [e for e in identified_errors(rig, plate.truth) if e.kind in limits]
    assert len(errors) == 16
    for error in errors:
        assert abs(error.size) < limits[error.kind], error
    done = subprocess.run(
        [*PLATE, "--mesh", DESK_MESH],
        cwd=plate.folder,
        env=plate.environment,
        capture_output=True,
        timeout=60,
        check=False,
    )
    assert (done.returncode, done.stdout) == (3, b"")


@pytest.mark.long
@pytest.mark.alone
@pytest.mark.needs("jackd", "cc")
def test_chain_from_measurement_to_touches_keeps_its_promises() -> None:
    """Values found are the plate's, and touches are felt where they are.

    Stiffness and damping to some percent, as one plate shows.
    """
    results = session(seed=SEED, touched=2)
    assert results.held_out_error < 0.05
    for error in results.calibrated:
        assert abs(error.size) < 0.1, error
    for error in results.identified:
        limit = 1e-3 if error.kind == "place" else 0.1
        assert abs(error.size) < limit, error
    assert len(results.touches) == 2
    assert min(touch.measured_db for touch in results.touches) > 6

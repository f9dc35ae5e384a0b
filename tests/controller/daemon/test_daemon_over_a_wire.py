"""A whole daemon over a pseudo-terminal: what clients ask, what the amplifier does, who is told."""

import asyncio
import contextlib
import json
import logging
import os
import re
import signal
import socket
from collections.abc import AsyncIterator
from pathlib import Path

import pytest

from controller.api.async_client import AsyncClient
from controller.api.client_protocol import Notification
from controller.api.jsonrpc import ErrorCode, RpcError
from controller.cli.daemon import show_status
from controller.daemon.socket_lock import SocketLock
from controller.loop.intent import NO_CONTACTS
from controller.sources.touch import Touch, TouchFrame
from controller.sources.tuio import tuio_datagram
from daemon_bench import (
    PATIENCE,
    PLACE,
    DaemonBench,
    daemon_at,
    far_end,
    running_daemon,
    until,
    until_state,
)
from drivers.amplifier import Amplifier
from drivers.protocol.messages import AmplifierState, Apply, LoadEnvelope
from drivers.registry import open_backend
from model.errors import InputError
from model.rig.file import load_rig
from rig_files import TWO_AMPLIFIERS
from sim.faults.fault_window import FaultWindow

READY = "READY_TO_SWITCH_ON"
ENABLED = "OPERATION_ENABLED"


@contextlib.asynccontextmanager
async def holding(
    client: AsyncClient, bench: DaemonBench, *places: tuple[float, float]
) -> AsyncIterator[None]:
    """Keep fingers down; begins once the amplifier plays for them."""

    async def repeat() -> None:
        while True:
            await client.touch(places or [PLACE])
            await asyncio.sleep(0.03)

    task = asyncio.create_task(repeat())
    try:
        await until(lambda: any(bench.far.device.status().levels))
        yield
    finally:
        task.cancel()
        await asyncio.gather(task, return_exceptions=True)


async def refusal(work: object) -> ErrorCode:
    """With which code a request is refused."""
    with pytest.raises(RpcError) as caught:
        await work  # type: ignore[misc]
    return caught.value.code


async def told_of(client: AsyncClient, *topics: str) -> Notification:
    """The next notification of one of these topics."""
    async with asyncio.timeout(20):
        async for told in client.events():
            if told.topic in topics:
                return told
    raise AssertionError("the connection ended")


async def test_touches_are_felt_while_armed_and_only_then(tmp_path: Path) -> None:
    """Disarmed nothing is sent; armed the pattern is played and told; lifted, all is silent."""
    async with running_daemon(tmp_path) as bench, await bench.client() as era:
        await until_state(era, READY)
        await era.subscribe("pattern", "silence", "contacts")
        await era.touch([PLACE])
        assert (await told_of(era, "contacts")).data["contacts"] == []
        (contact,) = (await told_of(era, "contacts")).data["contacts"]
        assert (contact["x_m"], contact["y_m"]) == pytest.approx(PLACE)
        assert contact["role"] is None
        assert not any(bench.far.device.status().levels)
        assert bench.far.device.status().state is AmplifierState.SWITCH_ON_DISABLED
        await era.arm("me", lease_s=30)
        async with holding(era, bench, PLACE, (0.25, 0.2)):
            told = (await told_of(era, "pattern")).data
            while len(told["contacts"]) == 1:  # that finger was still down when it was armed
                told = (await told_of(era, "pattern")).data
            assert [contact["role"] for contact in told["contacts"]] == ["quiet", "target"]
            assert told["contacts"][1]["level_db_sl"] == pytest.approx(20, abs=0.5)
            assert told["latency_ms"] > 0
            status = await era.status()
            assert (status.state, status.phase, status.armed_by) == (ENABLED, "armed", "me")
            assert 0 < (status.lease_left_s or 0) <= 30
            commanded = [told["drive"][era]["level"] for era in ("SW", "SE", "NE", "NW")]
            await until(
                lambda: bench.far.device.status().levels == pytest.approx(commanded, abs=1e-4)
            )
            assert (await era.status()).drive.keys() == told["drive"].keys()
        await era.touch([])
        await until(lambda: not any(bench.far.device.status().levels))
        assert (await told_of(era, "silence")).data["reason"]
        assert (await era.status()).drive == {}


@pytest.mark.parametrize(("wait", "is_shaped"), [("30 ms", True), ("0 ms", False)])
async def test_a_touch_waits_for_its_onset_only_where_it_may(
    tmp_path: Path, wait: str, is_shaped: bool
) -> None:
    """By default its envelopes are loaded before it is felt; without time to wait none are."""
    async with (
        running_daemon(tmp_path, f"touch_wait: {wait}\n") as bench,
        await bench.client() as era,
    ):
        await until_state(era, READY)
        await era.arm("me", lease_s=30)
        async with holding(era, bench):
            asked = [
                type(each.what) for each in bench.daemon._recorder.records() if each.way == "out"
            ]
            assert Apply in asked
            assert (LoadEnvelope in asked) is is_shaped


async def test_a_client_that_is_gone_leaves_no_finger(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Its contacts are lifted with its connection; others stay, for two clients are two sources."""
    monkeypatch.setattr("controller.sources.contacts.CONTACT_TIMEOUT", 60.0)  # nothing else lifts
    async with running_daemon(tmp_path) as bench, await bench.client() as era:
        await until_state(era, READY)
        other = await bench.client()
        await other.touch([(0.25, 0.2)])
        await era.touch([PLACE])
        await until(lambda: len(bench.daemon._publisher.view.contacts) == 2)
        await other.close()
        await until(lambda: len(bench.daemon._publisher.view.contacts) == 1)
        (left,) = (await era.status()).contacts
        assert (left.x_m, left.y_m) == pytest.approx(PLACE)


async def test_a_lease_that_is_not_renewed_disarms(tmp_path: Path) -> None:
    """Armed while it is renewed, disarmed a second after the last renewal of a lease of 1 s."""
    async with running_daemon(tmp_path) as bench, await bench.client() as era:
        await until_state(era, READY)
        lease = await era.arm("me", lease_s=1)
        for _ in range(3):
            await asyncio.sleep(0.4)
            await era.renew(lease.lease)
        assert (await era.status()).state == ENABLED
        loop = asyncio.get_running_loop()
        begin = loop.time()
        assert await until_state(era, READY, "SWITCH_ON_DISABLED") is not None
        assert loop.time() - begin >= 0.9
        await until_state(era, READY)
        assert bench.far.device.status().state is AmplifierState.SWITCH_ON_DISABLED
        assert await refusal(era.renew(lease.lease)) is ErrorCode.LEASE


async def test_one_arms_and_anybody_stops(tmp_path: Path) -> None:
    """Another lease is refused, a stop is not; it is latched until somebody clears."""
    async with running_daemon(tmp_path) as bench, await bench.client() as era:
        await until_state(era, READY)
        await era.arm("me", lease_s=30)
        async with await bench.client("bystander") as bystander, holding(era, bench):
            assert await refusal(bystander.arm("you")) is ErrorCode.LEASE
            await bystander.stop()
            await until(lambda: not any(bench.far.device.status().levels))
            status = await bystander.status()
        assert status.state == "QUICK_STOP_ACTIVE"
        assert "bystander" in status.cause
        assert status.armed_by is None
        assert bench.far.device.status().state is AmplifierState.QUICK_STOP_ACTIVE
        assert await refusal(era.arm("me")) is ErrorCode.WRONG_STATE
        await era.clear()
        await until_state(era, READY)
        await era.arm("me")
        await era.disarm()
        await until_state(era, READY)


async def test_a_stop_overtakes_the_arming_it_stops(tmp_path: Path) -> None:
    """Asked for at once on one connection: the daemon ends stopped, whoever comes first."""
    async with running_daemon(tmp_path) as bench, await bench.client() as era:
        await until_state(era, READY)
        arming = asyncio.ensure_future(era.arm("me"))
        await asyncio.sleep(0)
        await era.stop()
        await asyncio.gather(arming, return_exceptions=True)
        status = await era.status()
        assert status.state in ("QUICK_STOP_ACTIVE", "FAULT_REACTION_ACTIVE", "FAULT")
        assert status.armed_by is None
        assert bench.far.device.status().state is not AmplifierState.OPERATION_ENABLED


async def test_touches_over_tuio_are_felt(tmp_path: Path) -> None:
    """A datagram of a TUIO client becomes a contact under the name in the configuration."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    more = f'touch:\n  - {{name: table, url: "tuio:127.0.0.1:{port}"}}\n'
    async with running_daemon(tmp_path, more) as bench, await bench.client() as era:
        await until_state(era, READY)
        await era.arm("me")
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender:
            for number in range(1, 200):
                frame = TouchFrame("panel", 0.0, (Touch(7, 0.25, 0.75),))
                sender.sendto(tuio_datagram(frame, number), ("127.0.0.1", port))
                status = await era.status()
                if status.drive:
                    break
                await asyncio.sleep(0.02)
        (contact,) = status.contacts
        assert contact.source.startswith("table:")
        assert (contact.id, contact.role) == (7, "target")
        plate = load_rig(tmp_path / "rig.yaml").plate
        assert contact.x_m == pytest.approx(0.25 * plate.length)
        assert contact.y_m == pytest.approx(0.25 * plate.width)  # TUIO counts downwards


async def test_a_cut_link_is_told_and_comes_back_disarmed(tmp_path: Path) -> None:
    """COMM_LOST with a warning, then, once the amplifier is back, a fault that needs clear."""
    async with running_daemon(tmp_path) as bench, await bench.client() as era:
        await until_state(era, READY)
        await era.subscribe("link", "state")
        await era.arm("me", lease_s=30)
        bench.far.device.inject_fault(FaultWindow("hang"))
        await until_state(era, "COMM_LOST")
        status = await era.status()
        assert status.assume_energised
        assert status.armed_by is None
        assert "cables" in (status.remedy or "")
        told = (await told_of(era, "link")).data
        assert (told["event"], told["amplifier"]) == ("lost", "main")
        assert await refusal(era.arm("me")) is ErrorCode.WRONG_STATE
        with pytest.raises(RpcError, match=r"in COMM_LOST: .*; check cables") as caught:
            await era.clear()
        assert caught.value.code is ErrorCode.LINK
        await era.stop()
        bench.far.device.recover()
        await until_state(era, "FAULT")
        assert not (await era.status()).assume_energised
        assert bench.far.device.status().state is not AmplifierState.OPERATION_ENABLED
        await era.clear()
        await until_state(era, READY)
        await era.arm("me")


async def test_a_cut_link_is_one_line_of_the_log(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """With amplifier, cause and remedy; an attempt to come back is another only if it tells more.

    Clients hear of all that by the topics `state` and `link`: `log` does not say it again.
    """
    async with running_daemon(tmp_path) as bench, await bench.client() as era:
        await until_state(era, READY)
        await era.subscribe("link", "log")
        with caplog.at_level(logging.INFO, "controller"):
            bench.far.device.inject_fault(FaultWindow("hang"))
            told = [await told_of(era, "link", "log") for _ in range(3)]
            lost, *retried = caplog.records
            logging.getLogger("controller").info("something else")
            told.append(await told_of(era, "log"))
    assert [each.data.get("event", each.topic) for each in told] == [
        "lost",
        "retry",
        "retry",
        "log",
    ]
    assert told[-1].data["message"] == "something else"
    assert (lost.levelname, lost.getMessage()) == ("ERROR", f"{READY} -> COMM_LOST")
    assert vars(lost)["cause"].startswith("amplifier main: no re")
    assert "3 requests" in vars(lost)["cause"]
    assert "check cables" in vars(lost)["remedy"]
    (retry,) = [record.getMessage() for record in retried]
    assert told[1].data["message"] in retry


async def test_how_a_lost_amplifier_was_is_not_told_as_how_it_is(tmp_path: Path) -> None:
    """Neither while it is lost nor while it is being reopened: only when it was heard last."""
    async with running_daemon(tmp_path) as bench, await bench.client() as era:
        await until_state(era, READY)
        (known,) = (await era.status()).amplifiers
        assert (known.lost, known.levels, known.high_voltage) == (False, [0.0] * 4, False)
        bench.far.device.inject_fault(FaultWindow("hang"))
        await until_state(era, "COMM_LOST")
        begun = lost_for = (await era.status()).lost_for_s or 0.0
        while lost_for < begun + 1.0:  # two attempts to reopen it
            status = await era.status()
            (lost,) = status.amplifiers
            assert lost.lost
            unknown = (lost.state, lost.fault, lost.temperature_c, lost.high_voltage)
            assert (unknown, lost.levels) == ((None,) * 4, [])
            assert lost.reply_age_s is not None
            assert status.lost_for_s is not None
            assert lost.reply_age_s >= status.lost_for_s
            lost_for = status.lost_for_s
            await asyncio.sleep(0.01)
        bench.far.device.recover()
        await until_state(era, READY)
        status = await era.status()
        assert status.lost_for_s is None
        assert [each.lost for each in status.amplifiers] == [False]


async def test_who_is_lost_is_told_from_who_was_closed_with_it(tmp_path: Path) -> None:
    """Of two amplifiers: for as long as one is away, through all attempts; and once both are."""

    async def told() -> dict[str, tuple[bool, bool]]:
        amplifiers = (await era.status()).amplifiers
        return {each.name: (each.lost, each.closed_with_lost) for each in amplifiers}

    async def until_told(**expected: tuple[bool, bool]) -> None:
        for _ in range(int(PATIENCE / 0.01)):
            if await told() == expected:
                return
            await asyncio.sleep(0.01)
        pytest.fail(f"{await told()} in place of {expected}")

    there, lost, closed = (False, False), (True, False), (False, True)
    async with (
        far_end(tmp_path, changes=TWO_AMPLIFIERS) as far,
        daemon_at(far, tmp_path, changes=TWO_AMPLIFIERS) as bench,
        await bench.client() as era,
    ):
        await until_state(era, READY)
        assert await told() == {"main": there, "side": there}
        far.devices["side"].inject_fault(FaultWindow("hang"))
        await until_told(main=closed, side=lost)
        begun = lost_for = (await era.status()).lost_for_s or 0.0
        while lost_for < begun + 0.6:  # an attempt to reopen them
            assert await told() == {"main": closed, "side": lost}
            status = await era.status()
            lost_for = status.lost_for_s or 0.0
            await asyncio.sleep(0.01)
        main, side = (line for line in show_status(status).splitlines() if "serial://" in line)
        assert re.search(r"amplifier main .*\): closed because another was lost, last reply", main)
        assert re.search(r"amplifier side .*\): LOST, last reply", side)
        far.devices["main"].inject_fault(FaultWindow("hang"))
        await until_told(main=lost, side=lost)
        far.devices["side"].recover()
        await until_told(main=lost, side=closed)


async def test_a_pattern_that_a_cut_link_ends_is_told_to_be_over(tmp_path: Path) -> None:
    """Who draws what is played does not draw it for ever."""
    async with running_daemon(tmp_path) as bench, await bench.client() as era:
        await until_state(era, READY)
        await era.arm("me", lease_s=30)
        async with holding(era, bench):
            await era.subscribe("pattern", "silence")
            assert (await told_of(era, "pattern")).data["drive"]
            bench.far.device.inject_fault(FaultWindow("hang"))
            await until_state(era, "COMM_LOST")
            reason = (await told_of(era, "silence")).data["reason"]
            # On a busy machine the finger, said too seldom, may be taken for lifted first.
            assert "no reply" in reason or reason == NO_CONTACTS
        assert (await era.status()).drive == {}


async def test_a_cut_link_is_noticed_while_disarmed(tmp_path: Path) -> None:
    """Nobody has to arm to find out; back again, nothing has to be acknowledged."""
    async with running_daemon(tmp_path) as bench, await bench.client() as era:
        await until_state(era, READY)
        await era.subscribe("link")
        bench.far.device.inject_fault(FaultWindow("hang"))
        await until_state(era, "COMM_LOST")
        assert (await told_of(era, "link")).data["event"] == "lost"
        bench.far.device.recover()
        await until_state(era, READY)


async def test_a_fault_stops_is_dumped_and_needs_to_be_cleared(tmp_path: Path) -> None:
    """Over-voltage: stopped, latched, the last messages in a file, with their times."""
    more = "dumps: {folder: dumps, keep: 2}\n"
    async with running_daemon(tmp_path, more) as bench, await bench.client() as era:
        await until_state(era, READY)
        await era.arm("me", lease_s=30)
        async with holding(era, bench):
            bench.far.device.inject_fault(FaultWindow("over_voltage"))
            await until_state(era, "FAULT")
        assert not any(bench.far.device.status().levels)
        assert "OVER_VOLTAGE" in (await era.status()).cause
        assert await refusal(era.arm("me")) is ErrorCode.WRONG_STATE
        await era.clear()
        await until_state(era, READY)
        (dump,) = (tmp_path / "dumps").iterdir()
        head, *lines = [json.loads(line) for line in dump.read_text("utf-8").splitlines()]
        assert "OVER_VOLTAGE" in head["cause"]
        assert {"Arm", "Apply", "Status"} <= {line["message"] for line in lines}
        times = [line["time_s"] for line in lines]
        assert times == sorted(times)


async def test_a_dump_that_cannot_be_written_changes_nothing(tmp_path: Path) -> None:
    """Where a file has come in its folder's way, the daemon reacts to the fault as ever."""
    async with (
        running_daemon(tmp_path, "dumps: {folder: dumps}\n") as bench,
        await bench.client() as era,
    ):
        await until_state(era, READY)
        await era.arm("me", lease_s=30)
        (tmp_path / "dumps").write_text("in the way", "utf-8")
        bench.far.device.inject_fault(FaultWindow("arc"))
        await until_state(era, "FAULT")
        await era.clear()
        await until_state(era, READY)


async def test_an_amplifier_that_was_left_armed_is_disarmed_at_the_start(tmp_path: Path) -> None:
    """Whoever left it so: the daemon starts disarmed, and never plays on."""
    async with far_end(tmp_path) as far:
        amplifier = Amplifier(open_backend(far.url), reply_timeout=1.0)
        await amplifier.open()
        await amplifier.arm(2.0)
        assert far.device.status().state is AmplifierState.OPERATION_ENABLED
        await amplifier.close()
        async with daemon_at(far, tmp_path) as bench, await bench.client() as era:
            await until_state(era, READY)
            assert far.device.status().state is AmplifierState.SWITCH_ON_DISABLED


async def test_an_amplifier_in_a_fault_is_told_at_the_start(tmp_path: Path) -> None:
    """Its watchdog has tripped for a daemon that was killed: somebody must acknowledge."""
    async with far_end(tmp_path) as far:
        amplifier = Amplifier(open_backend(far.url), reply_timeout=1.0)
        await amplifier.open()
        await amplifier.arm(0.15)
        await amplifier.close()
        await until(lambda: far.device.status().state is AmplifierState.FAULT)
        async with daemon_at(far, tmp_path) as bench, await bench.client() as era:
            await until_state(era, "FAULT")
            assert "WATCHDOG" in (await era.status()).cause
            assert await refusal(era.arm("me")) is ErrorCode.WRONG_STATE
            await era.clear()
            await until_state(era, READY)


async def test_a_reload_takes_over_what_is_safe(tmp_path: Path) -> None:
    """Level down and leases while armed; not a level up, not another rig, not what is wrong."""
    more = "level_db_sl: 20\nlongest_lease: 60 s\n"
    async with running_daemon(tmp_path, more) as bench, await bench.client() as era:
        await until_state(era, READY)
        lease = await era.arm("me", lease_s=30)
        path, daemon = tmp_path / "daemon.yaml", bench.daemon
        original = path.read_text("utf-8")

        async def reload(*changes: tuple[str, str]) -> None:
            text = original
            for old, new in changes:
                assert old in text
                text = text.replace(old, new)
            path.write_text(text, "utf-8")
            await daemon.reload()

        await reload(("level_db_sl: 20", "level_db_sl: 10"), ("60 s", "20 s"))
        async with holding(era, bench):
            (contact,) = (await era.status()).contacts
        assert contact.level_db_sl == pytest.approx(10, abs=0.5)
        assert (await era.renew(lease.lease)).lease_s == 30  # leases that run keep their time
        await reload(("level_db_sl: 20", "level_db_sl: 21"), ("60 s", "10 s"))
        assert daemon._config.section.level_db_sl == 10
        assert daemon._config.section.longest_lease == 20
        await reload(("level_db_sl: 20", "level_db_sl: loud"))
        assert daemon._config.section.level_db_sl == 10
        await reload(("rig: rig.yaml", "rig: bench.yaml"), ("level_db_sl: 20", "level_db_sl: 5"))
        assert daemon._config.section.level_db_sl == 10
        await era.disarm()
        assert (await era.arm("me", lease_s=30)).lease_s == 20
        await era.disarm()
        await until_state(era, READY)
        await reload(("level_db_sl: 20", "level_db_sl: 21"))
        assert daemon._config.section.level_db_sl == 21


async def test_hangup_reloads_and_touch_sources_are_exchanged(tmp_path: Path) -> None:
    """SIGHUP with another list: the new source is heard, the old one's port is free again."""
    ports = []
    for _ in range(2):
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as free:
            free.bind(("127.0.0.1", 0))
            ports.append(free.getsockname()[1])
    more = f'touch:\n  - {{name: a, url: "tuio:127.0.0.1:{ports[0]}"}}\n'
    async with running_daemon(tmp_path, more) as bench, await bench.client() as era:
        await until_state(era, READY)
        path = tmp_path / "daemon.yaml"
        path.write_text(
            path.read_text("utf-8").replace(
                f'a, url: "tuio:127.0.0.1:{ports[0]}', f'b, url: "tuio:127.0.0.1:{ports[1]}'
            ),
            "utf-8",
        )
        os.kill(os.getpid(), signal.SIGHUP)
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender:
            for number in range(1, 400):
                frame = TouchFrame("panel", 0.0, (Touch(1, 0.5, 0.5),))
                sender.sendto(tuio_datagram(frame, number), ("127.0.0.1", ports[1]))
                contacts = (await era.status()).contacts
                if contacts:
                    break
                await asyncio.sleep(0.02)
        assert contacts[0].source.startswith("b:")
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as again:
            again.bind(("127.0.0.1", ports[0]))


async def test_a_second_daemon_at_the_same_socket_is_refused(tmp_path: Path) -> None:
    """By the lock, with the number of the process that runs; the first goes on."""
    async with running_daemon(tmp_path) as bench, await bench.client() as era:
        with pytest.raises(InputError, match=rf"\(process {os.getpid()}\)"):
            SocketLock(bench.socket)
        await until_state(era, READY)


async def test_the_wrong_amplifier_is_refused(tmp_path: Path) -> None:
    """Serial numbers of the configuration are those that must answer."""
    with pytest.raises(ConnectionError, match="A1, got SIM-main"):
        async with running_daemon(tmp_path, "serial_numbers: {main: A1}\n"):
            pass


async def test_what_is_told_of_everything_at_a_rate(tmp_path: Path) -> None:
    """Amplifiers and latency come by themselves; hello tells the rig whole."""
    async with running_daemon(tmp_path) as bench, await bench.client() as era:
        await until_state(era, READY)
        await era.subscribe("amplifiers", "latency", rate_hz=50)
        (amplifier,) = (await told_of(era, "amplifiers")).data["amplifiers"]
        assert (amplifier["serial_number"], amplifier["state"]) == (
            "SIM-main",
            "SWITCH_ON_DISABLED",
        )
        assert (await told_of(era, "latency")).data["latency_ms"]["count"] == 0
        hello = await era.hello("again")
        assert hello.rig.simulated
        assert [(place.name, place.channel) for place in hello.rig.eras] == [
            ("SW", 0),
            ("SE", 1),
            ("NE", 2),
            ("NW", 3),
        ]
        assert hello.rig_text == (tmp_path / "rig.yaml").read_text("utf-8")
        assert (hello.table.cells_x, hello.table.cells_y) == (4, 3)

"""The client in JavaScript under Node.js."""

import asyncio
import json
import os
import re
from pathlib import Path

import pytest

from processes.daemons import (
    ENABLED,
    PATIENCE,
    READY,
    DaemonBench,
    next_event,
    ready_daemon,
    until_state,
)
from processes.installed import installed_program

ROOT = Path(__file__).parents[2]


BUTTON = ROOT / "examples" / "javascript" / "button.mjs"
TARGET, QUIET = "0.08,0.06", "0.22,0.16"


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
        predicted = pattern["predicted_contrast_db"]
        assert float(contrast) == pytest.approx(predicted, abs=0.05)
        assert await until_state(era, READY) == READY
        assert not (await era.status()).contacts
        process = await started(bench, QUIET, TARGET)
        await until_state(era, ENABLED)
        process.send_signal(2)
        status, _, _ = await ended(process)
        assert status == 130
        await until_state(era, "QUICK_STOP_ACTIVE")
        assert max(bench.far.summary().levels) == 0


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
        _, out, _ = await ended(process)
        *states, lost = out.splitlines()
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
    process = await started(None, place)
    status, _, err = await ended(process)
    assert status == expected
    assert message in err
    assert len(err.splitlines()) == 1

"""What a daemon keeps of the time before something has stopped its plate."""

import json
import math
from collections.abc import Awaitable, Callable
from pathlib import Path
from typing import Any

import pytest

from controller.api.client import AsyncClient
from controller.api.jsonrpc import ErrorCode
from controller.operation.operator import (
    MAX_DECISIONS,
    MAX_LINE,
    MAX_RECORDS,
    MAX_REQUESTS,
    FaultDumps,
    write_dump,
)
from courses import Planted
from daemons import PLACE, DaemonBench, error_code, holding, ready_daemon, until
from sim.faults import FaultWindow
from virtual_lines import in_virtual_time


def dumped(folder: Path, kind: str) -> list[str]:
    """The dumps of a kind."""
    return [each.read_text("utf-8") for each in folder.glob(f"dumps/era-{kind}-*.jsonl")]


async def fails_in_the_loop(bench: DaemonBench, era: AsyncClient) -> None:
    """Let a turn of the control loop fail once."""

    def fail() -> bool:
        del vars(bench.daemon._controller.cycle._wake)["clear"]
        raise Planted("in the loop")

    vars(bench.daemon._controller.cycle._wake)["clear"] = fail


async def reports_a_fault(bench: DaemonBench, era: AsyncClient) -> None:
    """Let the amplifier have a fault."""
    bench.far.device.inject_fault(FaultWindow(fault="over_voltage"))


async def is_stopped(bench: DaemonBench, era: AsyncClient) -> None:
    """Stop as a client."""
    await era.stop()


@pytest.mark.parametrize(
    ("stops", "kind", "cause"),
    [
        (fails_in_the_loop, "fault", "in the loop"),
        (reports_a_fault, "fault", "OVER_VOLTAGE"),
        (is_stopped, "stop", "stopped by 'test'"),
    ],
)
@in_virtual_time
async def test_dump_names_the_last_touch_and_request_before_a_stop(
    tmp_path: Path,
    stops: Callable[[DaemonBench, AsyncClient], Awaitable[None]],
    kind: str,
    cause: str,
) -> None:
    """With what was played for the finger, what was refused, and how the plate came to stop."""
    async with ready_daemon(tmp_path, "dumps: {folder: dumps}\n") as (bench, era):
        lease = await era.arm("me", lease_s=30)
        assert await error_code(era.play("none", PLACE)) is ErrorCode.REFUSED
        async with holding(era, far=bench.far):
            await stops(bench, era)
            await until(lambda: dumped(tmp_path, kind))
        bench.far.device.recover()
    (text,) = dumped(tmp_path, kind)
    head, *lines = map(json.loads, text.splitlines())
    assert cause in head["cause"]
    assert lease.lease not in text

    def last(key: str, value: object = None) -> Any:
        """The last record with a key, or with a value of it."""
        return [each for each in lines if each.get(key) and value in (None, each[key])][-1]

    (finger,), (felt,) = last("contacts")["contacts"], last("pattern")["pattern"]
    assert (finger["key"], finger["x"]) == (["api:1:python", 1], pytest.approx(PLACE[0]))
    assert (felt["contact"]["key"], felt["verdict"]) == (finger["key"], "own")
    assert (last("request", "touch")["client"], last("request", "arm")["outcome"]) == (
        *("test", "done"),
    )
    assert "unknown effect" in last("request", "play")["refused"]
    assert last("request", "stop" if kind == "stop" else "touch")["time_s"] >= finger["since"]
    assert last("state")["state"].startswith("OPERATION_ENABLED -> ")
    assert {"Arm", "Set", "Reply"} <= {each.get("message") for each in lines}
    assert (times := [each["time_s"] for each in lines]) == sorted(times)


def test_what_is_kept_for_a_dump_is_bounded(tmp_path: Path) -> None:
    """Whatever comes, in number and in length; a client that repeats itself leaves the others."""
    dumps, long = FaultDumps(tmp_path), "x" * 70_000
    dumps.requested("other", "arm", 0.0)
    for _ in range(10 * MAX_REQUESTS):
        dumps.requested("me", "touch", 1.0)["outcome"] = long
    assert [each["times"] for each in dumps._requests.values()] == [1, 10 * MAX_REQUESTS]
    for number in range(10 * MAX_RECORDS):
        dumps.requested(f"client {number}", "stop", 2.0)
        dumps.records.append({"time_s": 2.0, "message": long})
        dumps.decisions.append({"time_s": math.inf, "contacts": [long]})
    kept = [*dumps.records, *dumps._requests.values(), *dumps.decisions]
    assert len(kept) <= MAX_RECORDS + MAX_REQUESTS + MAX_DECISIONS
    lines = write_dump(tmp_path, kept, cause="").read_text("utf-8").splitlines()
    assert max(map(len, lines)) <= MAX_LINE
    assert "Infinity" not in "".join(lines)

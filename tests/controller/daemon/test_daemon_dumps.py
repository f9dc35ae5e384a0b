"""What a daemon keeps of the time before something has stopped its plate."""

import json
import math
from collections.abc import Awaitable, Callable
from pathlib import Path
from typing import Any

import pytest

from controller.api.async_client import AsyncClient
from controller.api.jsonrpc import ErrorCode
from controller.operation.dumps import (
    MAX_DECISIONS,
    MAX_LINE,
    MAX_RECORDS,
    MAX_REQUESTS,
    FaultDumps,
    write_dump,
)
from controller.operation.states import DaemonState, Operation
from courses import Planted
from daemon_bench import PLACE, DaemonBench, error_code, holding, ready_daemon, until
from sim.faults.fault_window import FaultWindow
from virtual_loop import in_virtual_time


def read_lines(path: Path) -> list[dict[str, Any]]:
    """The records of a dump, which are strict JSON."""

    def refuse(name: str) -> None:
        raise ValueError(f"{name} is not JSON")

    lines = path.read_text("utf-8").splitlines()
    return [json.loads(line, parse_constant=refuse) for line in lines]


async def fails_in_the_loop(bench: DaemonBench, era: AsyncClient) -> None:
    """Let the next turn of the control loop fail."""
    controller = bench.daemon._controller
    step = controller.step

    async def fail() -> None:
        controller.step = step  # type: ignore[method-assign]
        raise Planted("in the loop")

    controller.step = fail  # type: ignore[method-assign]


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
            assert await error_code(era.renew("not the lease")) is ErrorCode.LEASE
            await stops(bench, era)
            folder = tmp_path / "dumps"
            await until(lambda: [*folder.glob(f"era-{kind}-*.jsonl")])
        (path,) = folder.iterdir()
        bench.far.device.recover()
    head, *lines = read_lines(path)
    assert cause in head["cause"]
    assert [each["time_s"] for each in lines] == sorted(each["time_s"] for each in lines)
    (finger,) = [each for each in lines if each.get("contacts")][-1]["contacts"]
    assert finger["key"] == ["api:1:python", 1]
    assert (finger["x"], finger["y"]) == pytest.approx(PLACE)
    (felt,) = [each for each in lines if "pattern" in each][-1]["pattern"]
    assert felt["contact"]["key"] == finger["key"]
    assert felt["verdict"] == "own"
    requests = {each["request"]: each for each in lines if "request" in each}
    assert {requests[name]["client"] for name in ("arm", "play", "touch")} == {"test"}
    assert requests["touch"]["times"] >= 1
    assert requests["arm"]["outcome"] == "done"
    assert "unknown effect" in requests["play"]["refused"]
    assert ("stop" in requests) == (kind == "stop")
    states = [each["state"] for each in lines if "state" in each]
    assert states[-1].startswith("OPERATION_ENABLED -> ")
    assert {each["message"] for each in lines if "message" in each} >= {"Arm", "Commit"} - {
        "Commit"
    }
    assert lease.lease not in path.read_text("utf-8")
    assert "not the lease" not in path.read_text("utf-8")


def test_what_is_kept_for_a_dump_is_bounded(tmp_path: Path) -> None:
    """Whatever comes, in number and in length; a client that repeats itself leaves the others."""
    dumps = FaultDumps(tmp_path)
    dumps.requested("other", "arm", 0.0)["outcome"] = "done"
    for _ in range(10 * MAX_REQUESTS):
        dumps.requested("me", "touch", 1.0)["outcome"] = "x" * 70_000
    assert [each["times"] for each in dumps._requests.values()] == [1, 10 * MAX_REQUESTS]
    for number in range(10 * MAX_RECORDS):
        dumps.requested(f"client {number}", "stop", 2.0)
        dumps.records.append({"time_s": 2.0, "message": "x" * 70_000})
        dumps.decisions.append({"time_s": math.inf, "contacts": ["x" * 70_000]})
        dumps.state_changed(Operation(), Operation(DaemonState.NOT_READY, "x" * 70_000))
    path = write_dump(
        tmp_path,
        [*dumps.records, *dumps._requests.values(), *dumps.decisions, *dumps._transitions],
        cause="",
    )
    lines = read_lines(path)
    assert len(lines) <= 1 + MAX_RECORDS + MAX_REQUESTS + MAX_DECISIONS + 20
    assert max(map(len, path.read_text("utf-8").splitlines())) <= MAX_LINE

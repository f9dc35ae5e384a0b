"""A second host of an amplifier, over every wire, in the same and in another process."""

import subprocess
import sys
from collections.abc import AsyncIterator, Iterator
from contextlib import contextmanager

import pytest

from drivers.amplifier import Amplifier
from drivers.backends.host_lock import HostLock
from drivers.errors import LinkError
from drivers.protocol.messages import AmplifierState
from drivers.registry import open_backend
from model.rig.rig import Rig
from wires import WIRES, FarSide, far_side

REPLY_TIMEOUT = 2.0  # s


@pytest.fixture(params=list(WIRES))
async def far(request: pytest.FixtureRequest, coarse_rig: Rig) -> AsyncIterator[FarSide]:
    """The paper's amplifier behind each wire."""
    async with far_side(WIRES[request.param], coarse_rig) as far:
        yield far


async def test_second_host_is_refused_until_the_first_closes(
    far: FarSide,
) -> None:
    """Within one process a second host is refused, and the first one is undisturbed."""
    first = Amplifier(open_backend(far.url), reply_timeout=REPLY_TIMEOUT)
    second = Amplifier(open_backend(far.url), reply_timeout=REPLY_TIMEOUT)
    await first.open()
    await first.arm(2.0)
    with pytest.raises(LinkError):
        await second.open()
    assert (await first.heartbeat()).state is AmplifierState.OPERATION_ENABLED
    await first.close()
    await second.open()
    assert (await second.disarm()).state is AmplifierState.SWITCH_ON_DISABLED
    await second.close()


@contextmanager
def held_by_another_program(name: str) -> Iterator[None]:
    """Run a process that holds the right to arm, and kill it at the end."""
    hold = (
        "import sys; from drivers.backends.host_lock import HostLock; "
        f"host = HostLock({name!r}); host.acquire(); print('held', flush=True); sys.stdin.read()"
    )
    with subprocess.Popen(
        [sys.executable, "-c", hold], stdin=subprocess.PIPE, stdout=subprocess.PIPE
    ) as other:
        assert other.stdout is not None
        assert other.stdout.readline() == b"held\n"
        try:
            yield
        finally:
            other.kill()


async def test_one_process_arms_over_tcp_and_any_may_stop(coarse_rig: Rig) -> None:
    """The right to arm belongs to one process until it ends; reading and stopping need none."""
    async with far_side(WIRES["modbus+tcp"], coarse_rig) as far:
        amplifier = Amplifier(open_backend(far.url), reply_timeout=REPLY_TIMEOUT)
        with held_by_another_program(far.url.removeprefix("modbus+tcp://")):
            await amplifier.open()
            assert (await amplifier.status()).state is AmplifierState.SWITCH_ON_DISABLED
            assert (await amplifier.stop()).state is not AmplifierState.OPERATION_ENABLED
            await amplifier.clear()
            with pytest.raises(LinkError, match=r"127\.0\.0\.1"):
                await amplifier.arm(2.0)
        await amplifier.close()
        await amplifier.open()
        assert (await amplifier.arm(2.0)).state is AmplifierState.OPERATION_ENABLED
        await amplifier.close()


def test_host_lock_is_exclusive_until_released() -> None:
    """Locks are by name; acquire and release are idempotent."""
    one, same, other = HostLock("here:1/1"), HostLock("here:1/1"), HostLock("here:1/2")
    one.acquire()
    one.acquire()
    other.acquire()
    with pytest.raises(LinkError, match="here:1/1"):
        same.acquire()
    one.release()
    one.release()
    same.acquire()
    same.release()
    other.release()

"""A second host of an amplifier, over every wire, and the lock of instruments."""

from collections.abc import AsyncIterator

import pytest

from drivers.amplifier import Amplifier
from drivers.backends.host_lock import HostLock
from drivers.errors import LinkError
from drivers.protocol.messages import AmplifierState
from drivers.registry import open_backend
from model.rig.rig import Rig
from rig_on_wire import FarSide, far_side
from wires import WIRES

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

"""A host that is killed while an amplifier plays, over a line of the system and in real time."""

import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager

import pytest

from drivers.amplifier import Amplifier
from drivers.conformance import CHECKS, CheckResult, Result, run_check
from drivers.registry import open_backend
from model.rig.file import example_rig_path

pytestmark = pytest.mark.real_time

SIMULATE = "import sys; from sim.cli import app; app(['sim', sys.argv[1], '--serial'])"
WITHOUT_WATCHDOG = (
    "from sim.amplifier.amplifier import SimulatedAmplifier as A; tick = A.tick; "
    "A.tick = lambda self, now: (setattr(self, '_last_fed', now), tick(self, now))[1]; "
)


@contextmanager
def far_end(program: str) -> Iterator[str]:
    """A simulated amplifier in a process of its own; yields its URL."""
    with subprocess.Popen(
        [sys.executable, "-P", "-c", program, str(example_rig_path())],
        stdout=subprocess.PIPE,
        text=True,
    ) as process:
        assert process.stdout is not None
        yield process.stdout.readline().strip().removeprefix("main: ")
        process.kill()


async def result_at(url: str) -> CheckResult:
    """The result of the check, and whether the amplifier can be used afterwards."""
    (check,) = [check for check in CHECKS if check.name == "vanished_host"]
    amplifier = Amplifier(open_backend(url), reply_timeout=1.0)
    await amplifier.open()
    result = await run_check(check, amplifier, url=url)
    await amplifier.arm()
    await amplifier.disarm()
    await amplifier.close()
    return result


@pytest.mark.long
@pytest.mark.alone
async def test_amplifier_with_a_watchdog_is_found_in_fault() -> None:
    """It has fallen silent although nothing was sent any more."""
    with far_end(SIMULATE) as url:
        assert (await result_at(url)).result is Result.PASSED


async def test_amplifier_that_plays_on_is_found() -> None:
    """As behind a backend that only imitates a watchdog: what it says must be seen from afar."""
    with far_end(WITHOUT_WATCHDOG + SIMULATE) as url:
        result = await result_at(url)
    assert result.result is Result.FAILED
    assert "OPERATION_ENABLED" in result.seen

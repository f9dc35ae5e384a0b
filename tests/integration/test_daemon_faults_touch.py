"""Touches that flood, over UDP to the whole daemon."""

import json
import time
from pathlib import Path

import pytest

from daemon_bench import far_end, until
from daemon_process import armed, daemon_process
from floods import flood
from journal import Journal, loudness
from tuio_panel import free_port, panel

pytestmark = [pytest.mark.real_time, pytest.mark.alone]


async def test_few_of_a_flood_of_touches_become_sets(tmp_path: Path) -> None:
    """Of up to three fingers that jump at 10 kHz, fewer than a tenth; none after the last lift."""
    port = free_port()
    async with (
        far_end(tmp_path) as far,
        daemon_process(tmp_path, far, panel(port)) as daemon,
        await daemon.client() as era,
    ):
        journal = Journal(far)
        await armed(era)
        begin = time.monotonic()
        async with flood("tuio", port, 10_000, 1.0) as sender:
            assert sender.stdout is not None
            counts = json.loads(await sender.stdout.readline())
        await until(lambda: loudness(far) == 0)
        silent = time.monotonic()
        await journal.hear(5)
        assert loudness(far) == 0
        assert not journal.raising_since(silent)
        assert len(journal.raising_since(begin)) < counts["sent"] / 10

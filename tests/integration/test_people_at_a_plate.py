"""Examples for several people in the shipped daemon, each finger with a vibration of its own."""

import asyncio
import contextlib
import os
from collections.abc import AsyncIterator
from itertools import combinations
from pathlib import Path

import pytest

import model
from controller.api.client import AsyncClient
from controller.api.methods import StatusResult
from daemons import PATIENCE, STARTING, holding, next_event, ready, until
from long_form import shortly
from patient_daemon import RESTING

EXAMPLES = Path(model.__file__).parents[1] / "examples"

ANY = (0.0, 500.0)
PEOPLE = {
    "car_display": {(0.15, 0.12): (60.0, 110.0), (0.38, 0.12): (180.0, 280.0)},
    "table": {(0.30, 0.26): ANY, (0.90, 0.26): ANY, (0.90, 0.54): ANY, (0.30, 0.54): ANY},
}
"""Where each person rests a finger, and the band [Hz] that the layout gives it."""

pytestmark = [pytest.mark.real_time, pytest.mark.alone]


@contextlib.asynccontextmanager
async def example_daemon(name: str, folder: Path, cache: Path) -> AsyncIterator[AsyncClient]:
    """`era daemon examples/NAME_daemon.yaml` as on its page, ready, and a client of it."""
    process = await asyncio.create_subprocess_exec(
        *(*RESTING, "daemon", str(EXAMPLES / f"{name}_daemon.yaml")),
        env=os.environ | {"XDG_CACHE_HOME": str(cache), "XDG_RUNTIME_DIR": str(folder)},
        stderr=asyncio.subprocess.DEVNULL,
    )
    socket = folder / "era-haptics" / "daemon.sock"
    try:
        await until(lambda: socket.is_socket() or process.returncode, patience=STARTING)
        async with await AsyncClient.connect(socket, name="test", timeout=PATIENCE) as era:
            await ready(era)
            yield era
    finally:
        process.terminate()
        await process.wait()


async def until_all_feel(era: AsyncClient, level_db_sl: float) -> StatusResult:
    """Wait until every finger feels a content at nearly this level."""
    async with asyncio.timeout(PATIENCE):
        while True:
            status = await era.status()
            levels = [each.level_db_sl for each in status.contacts if each.role == "target"]
            felt = [level for level in levels if level is not None and level > level_db_sl - 3]
            if levels and len(felt) == len(status.contacts):
                return status
            await asyncio.sleep(0.02)


@pytest.mark.parametrize("name", shortly(PEOPLE, ["car_display"]))
async def test_everyone_at_an_example_feels_their_own(
    name: str, tmp_path: Path, table_cache: Path
) -> None:
    """Each in the band of its region, at least 30 Hz apart, 6 dB and more above all others there.

    With nobody at the plate nothing plays.
    """
    people = PEOPLE[name]
    async with example_daemon(name, tmp_path, table_cache) as era, era.armed("test"):
        async with holding(era, *people):
            status = await until_all_feel(era, 20.0)
        contacts = sorted(status.contacts, key=lambda each: each.id)
        assert len(contacts) == len(people)
        frequencies = []
        for contact, (low, high) in zip(contacts, people.values(), strict=True):
            assert contact.verdict in ("own", "mixed")
            assert contact.promised_contrast_db is not None
            assert contact.promised_contrast_db > 6
            assert contact.frequency_hz is not None
            assert low <= contact.frequency_hz <= high
            frequencies.append(contact.frequency_hz)
        assert all(abs(one - other) >= 30 for one, other in combinations(frequencies, 2))
        await era.subscribe("silence")
        await era.touch([])
        await next_event(era, "silence")

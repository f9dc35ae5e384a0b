"""Opening a controller with a real table."""

import pytest

from controller.loop.loop import Controller
from controller_bench import BenchLines, FarEnd
from drivers.host.group import GroupState
from model.errors import InputError
from model.table.timing import Timing
from newest_contact import BuzzNewestContact
from small_table import small_problem, small_table
from virtual_loop import in_virtual_time


@in_virtual_time
async def test_open_refuses_a_table_without_playable_frequencies() -> None:
    """With the bands of amplifier and table; nothing stays open."""
    link = FarEnd(channels=4)
    link.amplifier.capabilities["frequency_min"] = 8000  # 400 Hz
    link.amplifier.capabilities["frequency_max"] = 20_000
    table = small_table()
    controller = Controller(
        small_problem().rig,
        table,
        lines=lambda: BenchLines({"main": link}),
        intent_source=BuzzNewestContact(),
        timing=Timing(table),
    )
    with pytest.raises(InputError, match=r"400 to 500 Hz.*60 to 250 Hz"):
        await controller.open()
    assert controller.group.state is GroupState.CLOSED
    assert not link.is_open

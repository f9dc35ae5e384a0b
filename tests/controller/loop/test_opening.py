"""Opening a controller with a real table."""

from dataclasses import replace

import pytest

from controller.group.amplifier_group import GroupState
from controller.loop.loop import Controller
from drivers.amplifier import Amplifier
from model.errors import InputError
from model.table.timing import Timing
from shaped_link import Link
from small_table import small_problem, small_table
from virtual_loop import in_virtual_time


@in_virtual_time
async def test_open_refuses_a_table_without_playable_frequencies() -> None:
    """With the bands of amplifier and table; nothing stays open."""
    link = Link(channels=4)
    link.amplifier.capabilities = replace(link.amplifier.capabilities, frequency_min=400.0)
    table = small_table()
    controller = Controller(
        small_problem().rig,
        table,
        amplifiers={"main": Amplifier(link)},
        timing=Timing(table),
    )
    with pytest.raises(InputError, match=r"400 to 500 Hz.*60 to 250 Hz"):
        await controller.open()
    assert controller.group_state is GroupState.CLOSED

"""What full level is, as the rig says of each amplifier, over wires of the protocol."""

from dataclasses import replace

import pytest

from chain import Chain
from controller.diagnosis.tone_player import TonePlayer
from drivers.errors import LinkError
from drivers.opening import Lines
from long_form import shortly
from model.rig.rig import Rig
from rig_on_wire import WIRES
from set_table import SetTable
from virtual_loop import in_virtual_time


@pytest.mark.parametrize("of_rig", [False, True])
@pytest.mark.parametrize("of_amplifier", [False, True])
@pytest.mark.parametrize("wire", shortly(WIRES, ["serial", "can+slcan"]))
@in_virtual_time
async def test_motion_and_output_are_not_taken_for_each_other(
    wire: str, of_amplifier: bool, of_rig: bool, coarse_rig: Rig
) -> None:
    """An amplifier opens, for touches and for measurements, where its full level is the rig's."""
    rigs = {False: coarse_rig, True: replace(coarse_rig, outputs=frozenset(coarse_rig.amplifiers))}
    rig = rigs[of_rig]
    table = SetTable({}, rig.plate)
    async with Chain.on(WIRES[wire], rig, table, plate=rigs[of_amplifier]) as chain:
        controller, player = chain.controller, TonePlayer(rig, Lines, chain.far.urls)
        if of_amplifier is of_rig:
            await controller.open()
            await controller.close()
            await player.open()
            await player.close()
            return
        for each in (controller, player):
            with pytest.raises(LinkError, match="full level must be"):
                await each.open()
        await player.close()

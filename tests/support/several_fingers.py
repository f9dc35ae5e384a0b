"""Several fingers on the paper's plate in virtual time, over a serial line, and what was sent."""

import asyncio
from collections.abc import AsyncIterator, Mapping
from contextlib import asynccontextmanager
from dataclasses import dataclass
from functools import cache
from types import MappingProxyType

import numpy as np

from chain import Chain, Position
from committed_sets import CommittedSets
from controller.effects.layout import SurfaceLayout
from controller.effects.player import EffectPlayer
from controller.loop.capabilities import PlaybackCapabilities
from controller.loop.envelopes import RAMPS_ONLY
from model.finger.perception import detection_threshold
from model.table.build import build_table
from model.table.table import LocalizationTable
from model.table.timing import Timing
from paper_table import smooth_rig
from rig_on_wire import after_each
from sim.far_ends.wires import Wire

LEFT, RIGHT, ABOVE = (0.126, 0.081), (0.234, 0.049), (0.069, 0.208)
"""Places on the paper's plate, 11 to 23 cm apart."""


@cache
def table() -> LocalizationTable:
    """The paper's plate at 29 frequencies."""
    return build_table(smooth_rig(), frequencies=np.linspace(40.0, 320.0, 29))


def playable(layers: int = 8) -> PlaybackCapabilities:
    """What amplifiers of that plate can play, of so many layers, with ramps alone."""
    return PlaybackCapabilities(
        "phased",
        ("phased",),
        (40.0, 320.0),
        {era.name: era.stroke for era in table().eras},
        RAMPS_ONLY,
        layers=layers,
    )


@dataclass
class Fingers(Chain):
    """Fingers by id, and what was sent and reported for them.

    committed: time [s], token and layers of every set and silence (no layers), as the amplifier
    carries them out.
    """

    def __post_init__(self) -> None:
        """Note what requests of the host change."""
        sets = CommittedSets()
        self.committed = sets.all
        after_each(self.far.device, sets.note)

    def contrasts(self, *, over: float = 0.25) -> Mapping[int, float]:
        """Level of each finger's content over all others there [dB], of the last seconds.

        By the frequencies that are reported for the fingers, and the amplitudes at their tips; as
        the table defines it: mean of the own tone over the tip, over the loudest point of the rest.
        """
        now, bench = asyncio.get_running_loop().time(), self.far.bench
        bench.advance(now)
        own = {each.contact.key.id: each.frequency for each in self.applied[-1].targets}
        found = {}
        for name, felt in bench.felt(now - over, now).items():
            frequency = own.get(int(name))
            thresholds = detection_threshold(np.array(felt.frequencies), bench.rig.threshold)
            amplitudes = felt.amplitude / thresholds[:, None]
            is_own = np.isclose(felt.frequencies, frequency or 0.0, atol=0.2)
            if is_own.sum() == 1 and len(felt.frequencies) > 1:
                others = np.sqrt((amplitudes[~is_own] ** 2).sum(axis=0)).max()
                level = float((amplitudes[is_own][0] * felt.weights).sum() / felt.weights.sum())
                found[int(name)] = 20 * np.log10(level / others)
        return found


@asynccontextmanager
async def fingers_on(
    table: LocalizationTable,
    layout: SurfaceLayout,
    *,
    at: Mapping[int, Position] = MappingProxyType({}),
    held: float = 0.0,
    layers: int = 8,
    breaks: str | None = None,
) -> AsyncIterator[Fingers]:
    """Fingers on a layout, armed, with an amplifier of four channels.

    at: those that are held for a time [s] first; breaks: the only rule of the witness that what is
    planted breaks.
    """
    async with Fingers.armed(
        Wire("serial", speed=921_600, unpluggable=True),
        smooth_rig(),
        table,
        intent_source=EffectPlayer(layout),
        timing=Timing(table),
        layers=layers,
        breaks=breaks,
    ) as fingers:
        fingers.at = {**at}
        await fingers.hold(held)
        yield fingers

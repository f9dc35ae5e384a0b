"""Fingers that rest are answered again when that passes for which one of them was held back."""

import math
from collections.abc import AsyncIterator, Mapping, Sequence
from contextlib import asynccontextmanager
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from chain import Chain
from controller.play.intent import HapticIntent, Target
from controller.sources.touch import Contact
from drivers.errors import CommandRefused
from drivers.host.group import Group
from long_form import shortly
from model.answer.answer_report import Timing
from model.rig.rig import Rig
from model.rig.rig_file import load_rig
from model.table.table import LocalizationTable
from model.table.table_file import build_table
from plates import contact_sets, smooth_rig
from real_wires import on_two_amplifiers
from several_fingers import LEFT, RIGHT
from several_fingers import table as paper_table
from sim.far_ends.wire_assignment import Wire
from virtual_lines import in_virtual_time, run_virtual

BUS = Wire("serial", speed=921_600, shared=True, line_kind="prompt")
LINES = Wire("serial", speed=921_600, unpluggable=True)


@dataclass
class EachItsOwn:
    """Every finger is to feel a buzz of its own, in a band [Hz] if there is one, and weakened."""

    band: tuple[float, float] | None = None
    gain_db: float = 0.0

    def intent(self, contacts: Sequence[Contact], now: float) -> HapticIntent:
        """Return it."""
        targets = tuple([Target(each.key, 14.0, band=self.band) for each in contacts])
        gains = {(each.key, False): self.gain_db for each in contacts}
        return HapticIntent(targets, gains_db=gains)


@cache
def eight_eras() -> Rig:
    """On two amplifiers."""
    path = Path(__file__).parents[3] / "examples" / "eight_eras.yaml"
    return load_rig(path, mesh="12x9")


@cache
def table() -> LocalizationTable:
    """Its table at 24 frequencies."""
    return build_table(eight_eras(), frequencies=np.linspace(40.0, 500.0, 24))


@cache
def timing() -> Timing:
    """Of that table."""
    return Timing(table())


def served(chain: Chain) -> int:
    """How many fingers feel something of their own."""
    felt = chain.applied[-1].targets if chain.applied else ()
    return sum(each.held_back is None for each in felt)


@asynccontextmanager
async def bus(number: int) -> AsyncIterator[Chain]:
    """Eight ERAs on one bus, open, and three fingers at random places for 0.3 s."""
    given: dict[str, Any] = {"intent_source": EachItsOwn(), "timing": timing()}
    async with Chain.on(BUS, eight_eras(), table(), **given) as chain:
        chain.is_felt = chain.must_be_felt = False
        await chain.open()
        chain.at = dict(enumerate(contact_sets(24, fingers=3, seed=5)[number]))
        await chain.hold(0.3)
        yield chain
        await chain.close()


@pytest.mark.parametrize("number", shortly(range(24), range(3)))
def test_fingers_down_before_arming_are_served_as_those_that_land_after_it(number: int) -> None:
    """Of three contents on two amplifiers of one bus, whose clocks are known from arming on.

    Within 0.2 s no fewer fingers feel theirs than once the same fingers land again.
    """

    async def run() -> tuple[int, int]:
        async with bus(number) as chain:
            await chain.operate("arm")
            await chain.hold(0.2)
            places, resting = chain.at, served(chain)
            chain.at = {}
            await chain.hold(0.02)
            chain.at = places
            await chain.hold(0.2)
            return resting, served(chain)

    resting, landing = run_virtual(run())
    assert resting >= landing


@in_virtual_time
async def test_fingers_that_rest_are_served_once_clocks_are_held(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Those of one amplifier each leave one of three out; 0.3 s after both are held none is."""
    known = {"a": math.inf, "b": math.inf}
    monkeypatch.setattr(Group, "clock_errors", property(lambda group: known))
    async with bus(0) as chain:
        await chain.operate("arm")
        await chain.hold(0.5)
        assert 0 < served(chain) < 3
        known |= {"a": 4e-6, "b": 4e-6}
        await chain.hold(0.3)
        assert served(chain) == 3


@asynccontextmanager
async def two_fingers(
    of: LocalizationTable | None = None, rig: Rig | None = None, **options: Any
) -> AsyncIterator[tuple[Chain, EachItsOwn]]:
    """Two fingers that rest on the paper's plate, armed, for 0.5 s; of: what answers first."""
    table, source = of or paper_table(), EachItsOwn()
    given: dict[str, Any] = {"intent_source": source, "timing": Timing(table), **options}
    async with Chain.on(LINES, rig or smooth_rig(), table, **given) as chain:
        chain.is_felt = chain.must_be_felt = False
        await chain.open()
        await chain.operate("arm")
        chain.at = {1: LEFT, 2: RIGHT}
        yield chain, source
        await chain.close()


@in_virtual_time
async def test_fingers_that_rest_are_served_by_another_table() -> None:
    """Of one frequency only one of two feels its own; of those of the paper both do."""
    few = build_table(smooth_rig(), frequencies=np.array([100.0]))
    async with two_fingers(few) as (chain, _):
        await chain.hold(0.5)
        assert served(chain) < 2
        chain.controller.replace_answers(paper_table(), Timing(paper_table()))
        await chain.hold(0.5)
        assert served(chain) == 2


@in_virtual_time
async def test_fingers_that_rest_are_served_within_limits_of_now() -> None:
    """An amplifier that allowed 0.3 % of its level allows all of it when it is armed again."""
    async with two_fingers(capabilities={"level_max": 30}) as (chain, _):
        await chain.hold(0.5)
        assert served(chain) == 0
        chain.far_end.amplifier.capabilities["level_max"] = 10_000
        for limits in chain.far_end.amplifier.capabilities["limits"]:
            limits["level_max"] = 10_000
        await chain.operate("disarm")
        await chain.operate("arm")
        await chain.hold(0.3)
        assert served(chain) == 2


@in_virtual_time
async def test_fingers_that_rest_are_served_once_a_ledger_admits_them() -> None:
    """It does not say when, as of a limit of duty: they are planned again within 1.1 s."""
    async with two_fingers() as (chain, _):
        planner = chain.controller.cycle.planner
        assert planner is not None
        check = planner.layers.check
        planner.layers.check = lambda layers: CommandRefused("duty limit reached")
        await chain.hold(0.5)
        assert served(chain) == 0
        planner.layers.check = check
        await chain.hold(1.2)
        assert served(chain) == 2


@in_virtual_time
async def test_fingers_that_rest_are_served_once_a_lost_amplifier_is_back() -> None:
    """Both feel theirs 0.3 s after all are open again and armed."""
    async with two_fingers(rig=on_two_amplifiers(smooth_rig())) as (chain, _):
        await chain.hold(0.3)
        assert served(chain) == 2
        chain.far_ends[1].fault("unplug")
        await chain.hold(0.5)
        chain.far_ends[1].recover()
        await chain.controller.open()
        await chain.controller.clear()
        chain.applied.clear()
        await chain.operate("arm")
        await chain.hold(0.3)
        assert served(chain) == 2


@pytest.mark.parametrize(
    ("before", "after"),
    [({"band": (99.0, 101.0)}, {"band": None}), ({"gain_db": -40.0}, {"gain_db": 0.0})],
    ids=["layout", "strength"],
)
@in_virtual_time
async def test_fingers_that_rest_are_served_as_is_wanted_now(
    before: Mapping[str, Any], after: Mapping[str, Any]
) -> None:
    """In one narrow band, or 40 dB weaker, a finger feels nothing; without that both do."""
    async with two_fingers() as (chain, source):
        vars(source).update(before)
        await chain.hold(0.5)
        assert served(chain) < 2
        vars(source).update(after)
        chain.controller.cycle.request_update()
        await chain.hold(0.3)
        assert served(chain) == 2

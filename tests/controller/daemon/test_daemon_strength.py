"""The strength of touch sources, clients and regions, from the API to the skin, in virtual time."""

import asyncio
import json
import math
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest

from controller.api.client import AsyncClient
from controller.api.jsonrpc import RpcError
from controller.demo.demonstration import layout_of_people
from controller.effects.player import MAX_NAMES
from daemons import DaemonBench, ready_daemon
from drivers.protocol.definition import QUANTITIES
from model.arrays import FloatArray
from model.errors import InputError
from model.rig.rig import Rig
from model.table.table import LocalizationTable
from model.table.table_file import build_table
from plates import make_paper_rig
from registry import threads
from virtual_lines import in_virtual_time

PLACES = {"left": (0.03, 0.11), "right": (0.216, 0.0572)}
FADE, WINDOW, STEP = 0.100, 0.050, 0.001  # s
LOWER = 10 ** (-6 / 20)  # of -6 dB
STEEPEST = (1 - LOWER) * math.pi / 2 * STEP / FADE
"""Largest change of an envelope of 1 along the raised cosine, within a step."""
LEVEL_STEP = 1 / QUANTITIES["level"].per_unit


@cache
def phased_table() -> LocalizationTable:
    """For two contents at once, of levels that a step on the wire does not round by much."""
    frequencies, rig = np.arange(60.0, 301.0, 20.0), make_paper_rig(12, 9)
    rig = replace(rig, promised_thresholds=(rig.threshold,))
    return build_table(rig, frequencies=frequencies, drive_mode="phased")


@asynccontextmanager
async def seats(folder: Path, more: str = "") -> AsyncIterator[tuple[DaemonBench, AsyncClient]]:
    """An armed daemon with a region for each of two, whose fingers lie on its plate."""
    layout = layout_of_people(make_paper_rig(12, 9).plate, dict.fromkeys(PLACES))
    (folder / "layout.yaml").write_text(json.dumps(layout), encoding="utf-8")

    def table(rig: Rig) -> LocalizationTable:
        return phased_table()

    async with ready_daemon(folder, f"layouts: {{panel: layout.yaml}}\n{more}", table=table) as (
        bench,
        era,
    ):
        bench.far.bench.place_fingers(PLACES, now=threads.now())
        await era.arm("test", lease_s=60)
        yield bench, era


async def hold(seconds: float, *touching: tuple[AsyncClient, str, str]) -> None:
    """Let clients report a finger each for a time [s]: their sources, and where."""
    end = threads.now() + seconds
    while threads.now() < end:
        for era, source, place in touching:
            await era.touch([PLACES[place]], source=source)
        await asyncio.sleep(0.02)


def envelope(bench: DaemonBench, finger: str, frequency: float, at: FloatArray) -> FloatArray:
    """Amplitude of one tone at a fingertip [m/s²] at times [s], under a Hann window."""
    records, _ = bench.far.bench.records(at[0] - WINDOW, at[-1] + WINDOW)
    felt = records[finger]
    turned = np.exp(-2j * np.pi * frequency * felt.times) * (felt.accelerations @ felt.weights)
    weights = np.cos(np.pi * np.clip((felt.times - at[:, None]) / WINDOW, -0.5, 0.5)) ** 2
    return np.asarray(np.abs(weights @ turned) / weights.sum(axis=1))


@in_virtual_time
async def test_gain_of_a_source_is_felt_at_its_finger_alone_along_a_fade(tmp_path: Path) -> None:
    """6 dB less within 100 ms and back, monotone and as steep as a raised cosine; others as before.

    On the amplifier exactly, at the skin as the plate follows.
    """
    async with seats(tmp_path) as (bench, era):
        both = [(era, name, name) for name in PLACES]
        await hold(1.0, *both)
        tones = {each.effect: each.frequency_hz for each in (await era.status()).contacts}
        planner = bench.daemon._controller.cycle.planner
        assert planner is not None
        (sent,) = [
            n for n, one in planner.layers.contents.items() if "right" in one.content.key[0].source
        ]
        settled_at = planner.layers.contents[sent].settled_at
        for gain, first, last in ((-6.0, 1.0, LOWER), (0.0, LOWER, 1.0)):
            set_at = threads.now()
            await era.strength(name="left", gain_db=gain)
            await hold(0.02, *both)
            led = np.arange(threads.now(), set_at + 0.2, STEP)
            moving = [
                np.array([abs(tone.transition.at(time)) for time in led])
                for channel in bench.far.amplifier.outputs
                for tone in channel
                if tone.frequency == pytest.approx(tones["left"], abs=0.01)
            ]
            await hold(0.4, *both)
            at = np.arange(set_at, set_at + 0.3, STEP)
            for name, frequency in tones.items():
                found = envelope(bench, name or "", frequency or 0.0, at)
                if name == "left":
                    moving.append(found)
                    reached = found[round((FADE + WINDOW / 2 + 0.01) / STEP) :]
                    assert 20 * np.log10(reached / found[0]) == pytest.approx(gain or 6.0, abs=0.2)
                    assert 20 * np.log10(found[-1] / found[0]) == pytest.approx(gain or 6, abs=0.05)
                else:
                    assert 20 * np.log10(found / found[0]) == pytest.approx(0.0, abs=0.1)
            assert planner.layers.contents[sent].settled_at == settled_at  # not sent again
            assert len(moving) == 5
            for course in moving:
                changes = np.diff(course / course[-1] * last) * math.copysign(1, last - first)
                rounded = LEVEL_STEP / np.abs(course).min() / (1 - LOWER)
                slack = 0.1 if course is moving[-1] else 0.01 + rounded
                assert -slack * STEEPEST <= changes.min()
                assert changes.max() <= (1 + slack) * STEEPEST


@in_virtual_time
async def test_strengths_are_kept_by_name(tmp_path: Path) -> None:
    """A client's for all its sources and those of its namesakes, and for what it plays elsewhere.

    Each name counts once, also after its client and the daemon have come back; what they leave
    below the threshold is held back. What is no strength, or not a known name, is refused.
    """

    async def levels(era: AsyncClient) -> list[float]:
        await asyncio.sleep(0.4)
        return [round(each.level_db_sl or 0.0, 1) for each in (await era.status()).contacts]

    async with seats(tmp_path, "strengths: kept.json\n") as (bench, era):
        one, other = await bench.client("seat"), await bench.client("seat")
        held = asyncio.create_task(hold(1e3, (one, "pen", "left"), (other, "seat", "right")))
        assert await levels(era) == [20, 20]
        await era.strength(name="pen", gain_db=-3)
        await era.strength(name="seat", gain_db=-6)
        assert await levels(era) == [11, 14]
        await era.strength(name="test", gain_db=-2)
        await era.play("buzz", PLACES["right"])
        assert await levels(era) == [11, 12]
        for gain, what in ((3.0, "at most 0"), (-41.0, "at least -40"), (math.nan, "finite")):
            with pytest.raises(InputError, match=f"^strength: gain_db must be .*{what}.*, got"):
                await era.strength(name="pen", gain_db=gain)
        with pytest.raises(RpcError, match=r"^name must be .*, got 'pan'; did you mean pen\? "):
            await era.strength(name="pan", gain_db=-6)
        held.cancel()
        await asyncio.gather(one.close(), other.close())
    async with seats(tmp_path, "strengths: kept.json\n") as (bench, era):
        regions = dict.fromkeys(PLACES, 0.0)
        kept = {"pen": -3, "seat": -6, "test": -2}
        assert (await era.status()).strengths == {**regions, **kept}
        one, other = await bench.client("seat"), await bench.client("another")
        held = asyncio.create_task(hold(1e3, (one, "pen", "left"), (other, "finger", "right")))
        assert await levels(era) == [11, 20]
        await other.hello("seat")  # another name by now, while its finger rests
        assert await levels(era) == [11, 14]
        await other.hello("another")
        await era.strength(name="another", gain_db=0)
        await era.strength(name="pen", gain_db=-40)
        assert await levels(era) == [-26, 20]
        weak, felt = (await era.status()).contacts
        assert (weak.verdict, felt.verdict) == ("held back", "own")
        assert "-46 dB" in (weak.held_back or "")
        held.cancel()
        await asyncio.gather(one.close(), other.close())
    async with seats(tmp_path, "strengths: kept.json\n") as (bench, era):
        assert (await era.strength(name="another", gain_db=-1)).strengths == {"another": -1}
        await bench.client("era")
        assert (await era.status()).strengths.keys() == {"another", *PLACES, "pen", "seat", "test"}


@in_virtual_time
async def test_two_people_at_one_panel_differ_by_region(tmp_path: Path) -> None:
    """6 dB less where one of them sits, for what is felt and what is played there; kept by name.

    Gains of source and region add up.
    """

    async def levels(era: AsyncClient) -> dict[str, float]:
        await asyncio.sleep(0.4)
        places = {x: name for name, (x, _) in PLACES.items()}
        contacts = (await era.status()).contacts
        return {places[each.x_m]: round(each.level_db_sl or 0.0, 1) for each in contacts}

    async def both(panel: AsyncClient) -> None:
        while True:
            await panel.touch([*PLACES.values()], source="panel")
            await asyncio.sleep(0.02)

    kept = "strengths: kept.json\n"
    for gains, expected in (
        ({"right": -6}, {"left": 20, "right": 14}),
        ({"panel": -3}, {"left": 17, "right": 11}),  # and the region's, which was kept
    ):
        async with seats(tmp_path, kept) as (bench, era):
            panel = await bench.client("seats")
            held = asyncio.create_task(both(panel))
            await asyncio.sleep(0.1)
            for name, gain in gains.items():
                await era.strength(name, gain)
            assert await levels(era) == expected
            await era.play("buzz", PLACES["right"])
            assert await levels(era) == expected
            with pytest.raises(RpcError, match=r"got 'rigt'; did you mean right\? "):
                await era.strength("rigt", -6)
            held.cancel()
            await panel.close()
    assert json.loads((tmp_path / "kept.json").read_text()) == {"right": -6, "panel": -3}


@in_virtual_time
async def test_a_disk_that_hangs_delays_no_other_request(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    """Strengths hold and are answered; touches and disarming go on, and the newest is kept.

    One that is full is logged once.
    """
    disk, full = asyncio.Event(), [True]

    async def hangs(work: Callable[[Path], None], file: Path) -> None:
        await disk.wait()
        if full:
            raise OSError(28, "No space left on device")
        work(file)

    async with seats(tmp_path, "strengths: kept.json\n") as (_, era):
        monkeypatch.setattr(asyncio, "to_thread", hangs)
        setting = [era.strength(name="test", gain_db=-1.0 - gain) for gain in range(10)]
        await asyncio.wait_for(asyncio.gather(*setting), 0.5)
        await era.touch([PLACES["left"]])
        await era.disarm()
        disk.set()
        await asyncio.sleep(0.1)
        assert caplog.text.count("strengths: not kept: [Errno 28] No space left on device") == 1
        full.clear()
        await era.strength("test", -11.0)
    assert json.loads((tmp_path / "kept.json").read_text()) == {"test": -11.0}


@in_virtual_time
async def test_names_with_a_strength_are_bounded(tmp_path: Path) -> None:
    """A client that invents sources fills neither memory nor file: 64 names may have one."""
    async with ready_daemon(tmp_path, "strengths: kept.json\n") as (_, era):
        names = [f"{number} {'x' * 70}" for number in range(MAX_NAMES + 1)]
        for name in names:
            await era.touch([PLACES["left"]], source=name)
            await asyncio.sleep(0.01)
            if name is names[-1]:
                with pytest.raises(RpcError, match=r"^strengths must be of at most 64 names"):
                    await era.strength(name=name, gain_db=-1)
                await era.strength(name=names[0], gain_db=0)
            await era.strength(name=name, gain_db=-1)
    kept = json.loads((tmp_path / "kept.json").read_text())
    assert kept == dict.fromkeys(names[1:], -1)


@in_virtual_time
async def test_every_name_that_is_listed_can_be_set(tmp_path: Path) -> None:
    """Also that of a sender whose own name is as long as may be, and not printable."""
    async with ready_daemon(tmp_path) as (bench, era):
        sender = f"table:tuio:10.0.0.2/{chr(0x1F600) * 100!a}"
        bench.daemon._layouts.player.strengths.note(sender)
        assert (await era.strength(name=sender, gain_db=-6)).strengths == {sender: -6}

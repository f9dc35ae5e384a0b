"""The strength of touch sources and clients, from the API to the skin, in virtual time."""

import asyncio
import json
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from pathlib import Path

import numpy as np

from controller.api.async_client import AsyncClient
from controller.demo.run import layout_of_people
from daemon_bench import DaemonBench, ready_daemon
from model.rig.rig import Rig
from model.table.build import build_table
from model.table.table import LocalizationTable
from paper_plate import make_paper_rig
from registry import clock
from sim.plant.fingers import fit_tones
from virtual_loop import in_virtual_time

PLACES = {"left": (0.03, 0.11), "right": (0.216, 0.0572)}
FADE, WINDOW, STEP = 0.100, 0.050, 0.001  # s

def _table(rig):
    return build_table(make_paper_rig(12, 9), frequencies=np.arange(60.0, 301.0, 20.0), drive_mode="phased")


@asynccontextmanager
async def seats(tmp_path, more=""):
    layout = layout_of_people(make_paper_rig(12, 9).plate, {"left": None, "right": None})
    (tmp_path / "layout.yaml").write_text(json.dumps(layout), encoding="utf-8")
    async with ready_daemon(tmp_path, "layout: layout.yaml\n" + more, table=_table) as (bench, era):
        yield bench, era


async def hold(era, seconds, **places):
    end = clock.now() + seconds
    while clock.now() < end:
        for source, at in places.items():
            await era.touch([at], source=source)
        await asyncio.sleep(0.02)


def envelope(bench, finger, frequency, since, until):
    b = bench.far.bench
    b.advance(clock.now())
    records, frequencies = b.records(since, until)
    r = records[finger]
    signal = r.accelerations @ r.weights / r.weights.sum()
    at = np.arange(since + WINDOW/2, until - WINDOW/2, STEP)
    out=[]
    for t in at:
        inside = (r.times >= t-WINDOW/2) & (r.times < t+WINDOW/2)
        a = fit_tones(r.times[inside], signal[inside,None], frequencies)
        out.append(abs(a[list(frequencies).index(frequency),0]))
    return at, np.array(out)


@in_virtual_time
async def test_it(tmp_path: Path) -> None:
    async with seats(tmp_path) as (bench, era):
        bench.far.bench.place_fingers(PLACES, now=clock.now())
        await era.arm("test", lease_s=60)
        await hold(era, 1.0, **PLACES)
        s = await era.status()
        for c in s.contacts: print(c)
        print(s.strengths)
        t0 = clock.now()
        task = asyncio.create_task(hold(era, 0.6, **PLACES))
        await asyncio.sleep(0.2)
        t1 = clock.now()
        print(await era.strength(name="left", gain_db=-6.0), clock.now()-t1)
        await task
        s = await era.status()
        for c in s.contacts: print(c)
        fr = {c.source.split(":")[-1]: c.frequency_hz for c in s.contacts}
        for f in PLACES:
            at, e = envelope(bench, f, fr[f], t0, clock.now())
            print(f, fr[f], [(round(t-t1,3), float(round(20*np.log10(x),2))) for t,x in list(zip(at,e))[::10]])
            print("monotone", np.diff(e).max()/e[0], "max step", -np.diff(e).min()/e[0], "hand", (1-10**(-6/20))*np.pi/2*STEP/FADE)

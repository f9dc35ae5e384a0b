"""Daemons that are killed at random moments: when does every channel fall silent?

    python tests/programs/kills.py [--kills 200] [--seed 1]

Each is `era daemon`, a process of its own, over a real wire; a client arms it, moves fingers about,
lifts them, disarms, stops. The amplifiers stay the same from one daemon to the next, which must
find what the one before has left. Prints a row a wire; exit status 1 where anything was too late.
"""

import argparse
import asyncio
import contextlib
import random
import signal
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[1] / "support"))
from controller.api.client import AsyncClient
from controller.api.jsonrpc import RpcError
from controller.api.link import Unreachable
from kit.plates import TWO_AMPLIFIERS, write_rig
from kit.wires import WIRES, far_side
from model.rig.rig_file import load_rig
from processes.daemons import (
    REACTION,
    STARTING,
    WATCHDOG,
    DaemonProcess,
    Journal,
    NotServing,
    daemon_process,
    energised,
    loudness,
    silent_from_of,
    until,
    until_state,
)
from sim.far_ends.wire_assignment import SimulatedWire

READY = "READY_TO_SWITCH_ON"
LIMIT = WATCHDOG + REACTION  # s; on the amplifier's clock, from its last sign of life
UNDER_WAY = 3  # requests that were on the wire when the daemon died: one, a stop and its repetition
EARLY = 0.1  # share of the daemons that are killed before they serve
LONGEST_LIFE = 0.8  # s; from when it was armed first
_AT_ONCE = 3  # wires side by side: also what loads the machine

PLACES: Sequence[tuple[str, SimulatedWire, Sequence[tuple[str, str]]]] = (
    ("serial", WIRES["serial"], ()),
    ("serial, two amplifiers", SimulatedWire("serial"), TWO_AMPLIFIERS),
    *((name, wire, ()) for name, wire in WIRES.items() if name != "serial"),
)
"""Wires by their names, and what is changed in the rig for them."""


@dataclass(frozen=True)
class Kill:
    """What a killed daemon left: how loud it was, and when all of it was over.

    after_feed, after_death [s]: from the amplifier's last sign of life, and from when the process
    was gone, to silence on every channel; None where nothing was energised. late: requests that an
    amplifier got after the death; faults: those that the amplifiers told; left: what still played.
    """

    wire: str
    level: float
    energised: int
    after_feed: float | None
    after_death: float | None
    late: int
    trips: int
    left: float

    @property
    def is_good(self) -> bool:
        """Whether every channel was silent in time, by the watchdog, and nothing came after."""
        in_time = self.after_feed is None or self.after_feed <= LIMIT + 1e-9
        return in_time and self.late <= UNDER_WAY * max(self.energised, 1) and self.left == 0


async def kill_daemons(
    place: tuple[str, SimulatedWire, Sequence[tuple[str, str]]],
    kills: int,
    *,
    seed: int,
    tell: Callable[[Kill], None] | None,
) -> list[Kill]:
    """Kill so many daemons, one after the other, at the same amplifiers; tell: called for each."""
    name, wire, changes = place
    chance = random.Random(seed)
    with tempfile.TemporaryDirectory(prefix="era-kills-") as path:
        folder = Path(path)
        rig = load_rig(write_rig(folder / "bench.yaml", *changes))
        async with far_side(wire, rig) as far:
            journal = Journal(far)
            done: list[Kill] = []
            starts = 0
            while len(done) < kills:
                # One that finds no amplifier ends, and a service manager would start it again.
                starts += 1
                assert starts <= 2 * kills + 5, "daemons end before they serve"
                with contextlib.suppress(NotServing):
                    is_early = chance.random() < EARLY
                    async with daemon_process(
                        folder, far, changes=changes, waits=not is_early
                    ) as daemon:
                        armed = asyncio.Event()
                        living = asyncio.create_task(
                            _live(daemon, random.Random(chance.random()), armed)
                        )
                        if not is_early:
                            await _first(armed, living, daemon)
                        await asyncio.sleep(chance.uniform(0.0, LONGEST_LIFE))
                        done.append(await _kill(name, daemon, journal))
                        living.cancel()
                        await asyncio.gather(living, return_exceptions=True)
                        if tell is not None:
                            tell(done[-1])
            return done


async def _first(armed: asyncio.Event, living: "asyncio.Task[None]", daemon: DaemonProcess) -> None:
    """Wait until it is armed; raises NotServing where its client has ended before."""
    waiting = asyncio.create_task(armed.wait())
    await asyncio.wait((waiting, living), timeout=STARTING, return_when=asyncio.FIRST_COMPLETED)
    waiting.cancel()
    if not armed.is_set():
        raise NotServing(str(daemon.log))


async def _kill(wire: str, daemon: DaemonProcess, journal: Journal) -> Kill:
    far = daemon.far
    daemon.process.send_signal(signal.SIGKILL)
    level, alive = loudness(far), energised(far)
    await daemon.process.wait()
    dead = time.monotonic()
    alive = sorted({*alive, *energised(far)})
    await until(lambda: not energised(far))
    ends = []
    for name in alive:
        fed = journal.last_fed(name)
        ends.append((silent_from_of(far, name), fed))
    await asyncio.sleep(0.05)  # what was still to come would have come
    return Kill(
        wire,
        level,
        len(alive),
        max((end - fed for end, fed in ends), default=None),
        max((end - dead for end, _ in ends), default=None),
        len(journal.since(dead)),
        sum(far.summary(name).state == "FAULT" for name in alive),
        loudness(far),
    )


async def _live(daemon: DaemonProcess, chance: random.Random, armed: asyncio.Event) -> None:
    """A daemon's usual events in quick succession, until it is killed."""
    with contextlib.suppress(ConnectionError, Unreachable, AssertionError):
        await daemon.serves()
        async with await daemon.client() as era:
            while True:
                try:
                    await _once(era, chance, armed)
                except RpcError:  # lost, or in a fault: acknowledge and continue
                    await asyncio.sleep(0.02)


async def _once(era: AsyncClient, chance: random.Random, armed: asyncio.Event) -> None:
    if await until_state(era, READY, "FAULT", "QUICK_STOP_ACTIVE") != READY:
        await era.clear()
        return
    await era.arm("life", lease_s=2)
    armed.set()
    end = time.monotonic() + chance.uniform(0.2, 1.0)
    while time.monotonic() < end:
        places = [
            (chance.uniform(0.02, 0.28), chance.uniform(0.02, 0.2))
            for _ in range(chance.choice((1, 1, 1, 2, 2, 0)))
        ]
        await era.touch(places)
        await asyncio.sleep(chance.uniform(0.0, 0.05))
    await era.touch([])
    await chance.choice((era.disarm, era.stop))()


async def kill_everywhere(
    kills: int,
    *,
    seed: int,
    serial: float = 0.5,
    tell: Callable[[Kill], None] | None = None,
) -> list[Kill]:
    """So many kills, a share of them over one serial line, the rest evenly at all other places."""
    elsewhere = round(kills * (1 - serial)) // (len(PLACES) - 1)
    shares = [elsewhere] * len(PLACES)
    shares[0] += kills - sum(shares)
    free = asyncio.Semaphore(_AT_ONCE)

    async def at(number: int) -> list[Kill]:
        async with free:
            return await kill_daemons(PLACES[number], shares[number], seed=seed + number, tell=tell)

    done = await asyncio.gather(*map(at, range(len(PLACES))), return_exceptions=True)
    for kills in done:  # once all have come to their end
        if isinstance(kills, BaseException):
            raise kills
    return [kill for kills in done for kill in kills]


def table(kills: Iterable[Kill]) -> str:
    """A row a wire."""
    kills = list(kills)
    rows = [
        "| wire | kills | energised | playing | silent after the last sign of life, at most "
        "| after the process was gone, at most | too late |",
        "|---|---|---|---|---|---|---|",
    ]
    for wire in (*Counter(kill.wire for kill in kills), "all"):
        of = [kill for kill in kills if wire in (kill.wire, "all")]
        fed = [kill.after_feed for kill in of if kill.after_feed is not None]
        dead = [kill.after_death for kill in of if kill.after_death is not None]
        rows.append(
            f"| {wire} | {len(of)} | {sum(kill.energised > 0 for kill in of)} "
            f"| {sum(kill.level > 0 for kill in of)} "
            f"| {1e3 * max(fed, default=0):.1f} ms | {1e3 * max(dead, default=0):.1f} ms "
            f"| {sum(not kill.is_good for kill in of)} |"
        )
    return "\n".join(rows)


def main() -> int:
    """The command."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--kills", type=int, default=200)
    parser.add_argument("--seed", type=int, default=1)
    options = parser.parse_args()
    dots = sys.stderr.write if sys.stderr.isatty() else None

    def tell(kill: Kill) -> None:
        if dots is not None:
            dots("." if kill.is_good else "!")

    kills = asyncio.run(kill_everywhere(options.kills, seed=options.seed, tell=tell))
    sys.stdout.write(f"{table(kills)}\n")
    bad = [kill for kill in kills if not kill.is_good]
    for kill in bad:
        sys.stdout.write(f"{kill}\n")
    return 1 if bad else 0


if __name__ == "__main__":
    sys.exit(main())

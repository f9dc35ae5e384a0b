"""The witness finds nothing in random days of a group, on every kind of wire, in virtual time."""

import asyncio

import pytest

from listened_line import ListenedLine, witness_of
from long_form import shortly
from random_group import RandomGroup
from sim.witness.violation import Violation
from virtual_loop import run_virtual
from words_line import KINDS

LINES = {"shared": (("a", "b"),), "each its own": (("a",), ("b",))}


def play(
    kind: str, seed: int, *lines: tuple[str, ...], is_lossy: bool, at_host: bool = False
) -> tuple[list[Violation], int]:
    """Return what a witness finds on lines of a kind, and how many frames it has seen."""
    named = {f"line{number}": (kind, names) for number, names in enumerate(lines)}
    witness = witness_of(named, times_s={"heartbeat": 0.2} if is_lossy else {"heartbeat": 0.1})

    async def run() -> None:
        ends = [
            ListenedLine(witness, name, kind, *names, at_host=at_host)
            for name, (_, names) in named.items()
        ]
        if at_host:
            for name in named:
                witness.faults(asyncio.get_running_loop().time(), name, are_on=True)
        await RandomGroup(ends, seed, is_lossy=is_lossy).run(60)

    run_virtual(run())
    return witness.finish(), witness.frames


@pytest.mark.parametrize("seed", shortly(range(8), [0]))
@pytest.mark.parametrize("lines", LINES)
@pytest.mark.parametrize("kind", KINDS)
def test_witness_finds_nothing_in_random_days(kind: str, lines: str, seed: int) -> None:
    """Layers, stops, disarms, faults, and watchdogs that expire, heard at either end."""
    for at_host in (False, True):
        found, frames = play(kind, seed, *LINES[lines], is_lossy=False, at_host=at_host)
        assert not found, str(found[0])
        assert frames > 200

"""The witness finds nothing in random days of a group, on every kind of wire, in virtual time."""

import pytest

from listened_line import ListenedLine, witness_of
from long_form import in_turn, shortly
from random_group import RandomGroup
from sim.witness.capture import Violation
from virtual_loop import run_virtual
from words_line import KINDS

LINES = {"shared": (("a", "b"),), "each its own": (("a",), ("b",))}


def play(
    kind: str, seed: int, *lines: tuple[str, ...], lossy_steps: int = 0, at_host: bool = False
) -> tuple[list[Violation], int]:
    """Return what a witness finds on lines of a kind, and how many frames it has seen."""
    named = {f"line{number}": (kind, names) for number, names in enumerate(lines)}
    witness = witness_of(named)

    async def run() -> None:
        ends = [
            ListenedLine(witness, name, kind, *names, at_host=at_host)
            for name, (_, names) in named.items()
        ]
        await RandomGroup(ends, seed).run(40, lossy_steps=lossy_steps)

    run_virtual(run())
    return witness.finish(), witness.frames


@pytest.mark.parametrize("seed", shortly(range(8), [0]))
@pytest.mark.parametrize(("kind", "lines"), in_turn(KINDS, [*LINES]))
def test_witness_finds_nothing_in_random_days(kind: str, lines: str, seed: int) -> None:
    """Layers, stops, disarms, faults, and watchdogs that expire, heard at the amplifiers' end."""
    found, frames = play(kind, seed, *LINES[lines])
    assert not found, str(found[0])
    assert frames > 200


@pytest.mark.parametrize("seed", shortly(range(8), [1]))
@pytest.mark.parametrize(("kind", "lines"), in_turn(KINDS, [*LINES]))
def test_witness_excuses_lost_and_doubled_frames(kind: str, lines: str, seed: int) -> None:
    """Both sides bear them as the decision says, and half a second later all rules hold again."""
    found, frames = play(kind, seed, *LINES[lines], lossy_steps=25, at_host=True)
    assert not found, str(found[0])
    assert frames > 200

"""One thing that every amplifier must do, and what came of trying it."""

from collections.abc import Callable, Coroutine
from dataclasses import dataclass
from typing import TypeAlias

from drivers.amplifier import Amplifier
from drivers.conformance.bench import Bench, ContractBroken
from drivers.errors import DriverError

Steps: TypeAlias = Callable[[Bench], Coroutine[None, None, None]]


@dataclass(frozen=True)
class Check:
    """One thing that must hold: a name, what it proves, and whether outputs are driven for it."""

    name: str
    proves: str
    drives: bool
    run: Steps


@dataclass(frozen=True)
class CheckResult:
    """What came of a check: problem is None where it is kept, else what happened instead."""

    check: Check
    problem: str | None


async def run_check(check: Check, amplifier: Amplifier) -> CheckResult:
    """Run one check on an open amplifier that is disarmed, and leave it so."""
    bench = Bench(amplifier)
    try:
        try:
            await check.run(bench)
        finally:
            if check.drives:
                await bench.rest()
    except (ContractBroken, DriverError) as problem:
        return CheckResult(check, str(problem))
    return CheckResult(check, None)

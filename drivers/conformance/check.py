"""One check of the contract, and its result."""

from collections.abc import Callable, Coroutine
from dataclasses import dataclass
from typing import TypeAlias

from drivers.amplifier import Amplifier
from drivers.conformance.bench import Bench, ContractViolation
from drivers.errors import DriverError

Steps: TypeAlias = Callable[[Bench], Coroutine[None, None, None]]


@dataclass(frozen=True)
class Check:
    """A requirement: its name, what it requires, and whether outputs are driven for it."""

    name: str
    requirement: str
    drives: bool
    run: Steps


@dataclass(frozen=True)
class CheckResult:
    """Result of a check; problem: what happened instead, None if it passed."""

    check: Check
    problem: str | None


async def run_check(check: Check, amplifier: Amplifier) -> CheckResult:
    """Run one check on an open, disarmed amplifier, and leave it disarmed."""
    bench = Bench(amplifier)
    try:
        try:
            await check.run(bench)
        finally:
            if check.drives:
                await bench.rest()
    except (ContractViolation, DriverError) as problem:
        return CheckResult(check, str(problem))
    return CheckResult(check, None)

"""`era plate conformance`."""

import json
from typing import Annotated

import typer

from model.commands.options import JsonOption


def conformance(
    name: Annotated[str, typer.Argument(metavar="ELEMENT", help="Name from era plate elements.")],
    as_json: JsonOption = False,
) -> None:
    """Check a plate element.

    Exit with 1 if a requirement is not met.
    """
    from model.fem.element_checks import CHECKS, COARSE, frequency_error, rate
    from model.fem.element_registry import element_of

    element = element_of(name)
    problems = {}
    for check in CHECKS:
        problem = problems[check.name] = check.problem(element)
        if not as_json:
            print(f"{'passed' if problem is None else 'FAILED'}  {check.requirement}.")
            if problem is not None:
                print(f"        {problem}")
        if problem is not None and check.name in ("nodes", "matrices"):
            break  # the other checks need these
    failed = [problem for problem in problems.values() if problem is not None]
    errors = [] if failed else [frequency_error(element, count) for count in (COARSE, 2 * COARSE)]
    if as_json:
        rows = [
            {"check": check.name, "requirement": check.requirement, "problem": problems[check.name]}
            for check in CHECKS
            if check.name in problems
        ]
        print(
            json.dumps(
                {
                    "element": name,
                    "passed": not failed,
                    "checks": rows,
                    "frequency_error": errors,
                    "rate": rate(*errors) if errors else None,
                }
            )
        )
    else:
        if errors:
            coarse, fine = errors
            print(
                f"lowest frequency of a thin plate: error {coarse:.2g} with {COARSE}x{COARSE} "
                f"elements, {fine:.2g} with {2 * COARSE}x{2 * COARSE}, rate "
                f"{rate(coarse, fine):.1f}"
            )
        print(f"{len(problems) - len(failed)} passed, {len(failed)} failed")
    if failed:
        raise typer.Exit(1)

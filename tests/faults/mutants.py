"""Judge the tests by random changes of the code (mutants), and print those that no test notices.

    python tests/faults/mutants.py [--package NAME ...] [--count N] [--seed N] [--minutes N]
                                   [--workers N] [--json FILE]

Each mutant changes one statement of a package: an operator, a number, a condition, a returned
value, or the statement is deleted. The tests nearest to the module (`make test-changed` has the
order) run in a copy of the tree until one fails. A mutant is *found* if a test fails that passes
without the mutant, or hangs. Without such a test it has *survived*. It is *unjudged* if the failing
test also fails without the mutant, or the tests cannot be run.

Some survivors behave as the original code does, so 100 % cannot be reached; the share found is for
comparison. The exit status is 0 whatever survives.
"""

import argparse
import ast
import difflib
import json
import random
import sys
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future, ProcessPoolExecutor, as_completed
from concurrent.futures import TimeoutError as RunOutOfTime
from dataclasses import asdict, dataclass, field, replace
from functools import partial
from pathlib import Path

from copies import FORK, ROOT, changed_copy, prepare, run_tests, sound_copy

sys.path.insert(0, str(ROOT / "tests" / "programs"))
from time_limit import TimeLimit

PACKAGES = ("model", "controller", "drivers", "sim", "era_haptics/lab")
OPTIONS = ("-x", "--in-order", "-m", "not long and not alone and not real_time")
"""Options of pytest. Tests in real time can fail on a busy machine, whatever the code does."""
MAX_TEST_FILES = 10
TEST_SECONDS = 45.0
HANG_LIMIT = 400.0  # s; far above the time of the tests on a busy machine
_COMPARISONS: dict[type[ast.cmpop], type[ast.cmpop]] = {
    ast.Lt: ast.LtE,
    ast.LtE: ast.Lt,
    ast.Gt: ast.GtE,
    ast.GtE: ast.Gt,
    ast.Eq: ast.NotEq,
    ast.NotEq: ast.Eq,
    ast.Is: ast.IsNot,
    ast.IsNot: ast.Is,
    ast.In: ast.NotIn,
    ast.NotIn: ast.In,
}
_OPERATORS: dict[type[ast.operator], type[ast.operator]] = {
    ast.Add: ast.Sub,
    ast.Sub: ast.Add,
    ast.Mult: ast.Div,
    ast.Div: ast.Mult,
    ast.FloorDiv: ast.Mult,
    ast.Mod: ast.Mult,
    ast.BitAnd: ast.BitOr,
    ast.BitOr: ast.BitAnd,
    ast.LShift: ast.RShift,
    ast.RShift: ast.LShift,
}


@dataclass(frozen=True)
class Mutant:
    """A changed module: its file, the line of the change, the new text, and the tests to run."""

    package: str
    file: str
    line: int
    text: str = field(repr=False)
    difference: str
    tests: tuple[str, ...] = ()

    def __str__(self) -> str:
        return f"{self.file}:{self.line}\n{self.difference}"


@dataclass(frozen=True)
class Verdict:
    """The result for a mutant: found, survived or unjudged, and by which test."""

    mutant: Mutant
    result: str
    test: str = ""


def statements(tree: ast.Module) -> Iterator[ast.stmt]:
    """Yield the statements of a module that can be changed: no imports, docstrings or `pass`."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Import | ast.ImportFrom | ast.Pass | ast.Global | ast.Nonlocal):
            continue
        is_text = isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant)
        if isinstance(node, ast.stmt) and not is_text:
            yield node


def mutations(statement: ast.stmt) -> list[Callable[[], object]]:
    """Return the changes that can be made to a statement, as functions that make them in place."""
    changes: list[Callable[[], object]] = []
    for node in _own_nodes(statement):
        match node:
            case ast.Compare(ops=[operator]) if type(operator) in _COMPARISONS:
                opposite = _COMPARISONS[type(operator)]()
                changes.append(partial(setattr, node, "ops", [opposite]))
            case ast.BinOp(op=operator) | ast.AugAssign(op=operator):
                if type(operator) in _OPERATORS:
                    changes.append(partial(setattr, node, "op", _OPERATORS[type(operator)]()))
            case ast.BoolOp(op=ast.And()):
                changes.append(partial(setattr, node, "op", ast.Or()))
            case ast.BoolOp(op=ast.Or()):
                changes.append(partial(setattr, node, "op", ast.And()))
            case ast.Constant(value=bool(value)):
                changes.append(partial(setattr, node, "value", not value))
            case ast.Constant(value=int(value) | float(value)):
                changes.append(partial(setattr, node, "value", value + 1))
            case ast.If(test=test) | ast.While(test=test) | ast.IfExp(test=test):
                changes.append(partial(setattr, node, "test", ast.UnaryOp(ast.Not(), test)))
            case ast.Return(value=ast.expr()):
                changes.append(partial(setattr, node, "value", None))
    return changes


def _own_nodes(node: ast.AST) -> Iterator[ast.AST]:
    """Yield a statement and its expressions, without nested statements, types and texts."""
    yield node
    for name, value in ast.iter_fields(node):
        if name in ("annotation", "returns", "decorator_list", "type_params"):
            continue
        children = value if isinstance(value, list) else [value]
        for child in children:
            is_other = isinstance(child, ast.stmt | ast.JoinedStr | ast.excepthandler)
            if isinstance(child, ast.AST) and not is_other:
                yield from _own_nodes(child)


def _is_deletable(statement: ast.stmt) -> bool:
    """Return whether code without a statement can still run: no variable loses its value."""
    match statement:
        case ast.Expr(value=ast.Call() | ast.Await()) | ast.AugAssign() | ast.Raise():
            return True
        case ast.Assign(targets=[ast.Attribute() | ast.Subscript()]):
            return True
    return False


def sampled_mutants(package: str, count: int, seed: int) -> list[Mutant]:
    """Return mutants of statements drawn at random, each of another statement."""
    places = []
    for path in sorted((ROOT / package).rglob("*.py")):
        tree = ast.parse(path.read_text("utf-8"))
        for index, statement in enumerate(statements(tree)):
            if mutations(statement) or _is_deletable(statement):
                places.append((path, index))
    draw = random.Random(f"{package} {seed}")
    selected = draw.sample(places, min(count, len(places)))
    return [_mutant(package, path, index, draw) for path, index in selected]


def _mutant(package: str, path: Path, index: int, draw: random.Random) -> Mutant:
    tree = ast.parse(path.read_text("utf-8"))
    original = ast.unparse(tree)
    statement = list(statements(tree))[index]
    changes = mutations(statement)
    if _is_deletable(statement):
        changes.append(partial(_delete, tree, statement))
    draw.choice(changes)()
    changed = ast.unparse(ast.fix_missing_locations(tree))
    lines = difflib.unified_diff(original.splitlines(), changed.splitlines(), n=1, lineterm="")
    difference = "\n".join(f"    {line}" for line in [*lines][3:])
    file = path.relative_to(ROOT).as_posix()
    return Mutant(package, file, statement.lineno, changed, difference)


def _delete(tree: ast.Module, statement: ast.stmt) -> None:
    for owner in ast.walk(tree):
        for _, block in ast.iter_fields(owner):
            if isinstance(block, list) and statement in block:
                block[block.index(statement)] = ast.Pass()


def with_tests(mutants: Sequence[Mutant]) -> list[Mutant]:
    """Return mutants with the test files nearest to their modules."""
    from changed_tests import nearest  # imports the product: only in a process of its own

    result = []
    for mutant in mutants:
        tests = [*nearest([mutant.file])][:MAX_TEST_FILES]
        result.append(replace(mutant, tests=tuple(tests)))
    return result


def judge(mutant: Mutant, sound: Path) -> Verdict:
    """Run the tests of a mutant until one fails, and that one without the mutant."""
    with changed_copy(sound, {mutant.file: mutant.text}) as folder:
        outcomes = run_tests(
            folder,
            mutant.tests,
            limit=HANG_LIMIT,
            options=OPTIONS,
            plugins=[TimeLimit(TEST_SECONDS)],
        )
    if outcomes is None:
        return Verdict(mutant, "found", "a test hangs")
    failed = [test for test, outcome in outcomes.items() if outcome not in ("passed", "skipped")]
    if not failed:
        return Verdict(mutant, "survived" if outcomes else _without_tests(mutant, sound))
    alone = run_tests(sound, failed[:1], limit=HANG_LIMIT) or {}
    is_sound = alone.get(failed[0]) == "passed"
    return Verdict(mutant, "found" if is_sound else "unjudged", failed[0])


def _without_tests(mutant: Mutant, sound: Path) -> str:
    """Return the result if no test ran: the module may not even be imported any more."""
    outcomes = run_tests(
        sound, mutant.tests, limit=HANG_LIMIT, options=OPTIONS, plugins=[TimeLimit(0.0)]
    )
    return "found" if outcomes else "unjudged"


def judged(mutants: Sequence[Mutant], *, workers: int, seconds: float) -> Iterator[Verdict]:
    """Judge mutants in parallel until the time is up."""
    with sound_copy() as sound, ProcessPoolExecutor(workers, FORK) as pool:
        futures: list[Future[Verdict]] = [pool.submit(judge, mutant, sound) for mutant in mutants]
        try:
            for future in as_completed(futures, timeout=seconds):
                yield future.result()
        except RunOutOfTime:
            sys.stdout.write(f"The time of {seconds / 60:g} minutes is up.\n")
            pool.shutdown(cancel_futures=True)


def _mutants_in_turn(packages: Sequence[str], count: int, seed: int) -> list[Mutant]:
    """Return mutants of packages in turn, so that all lose alike if the time is up."""
    by_package = [sampled_mutants(package, count, seed) for package in packages]
    mutants: list[Mutant] = []
    for group in zip(*by_package, strict=False):
        mutants += group
    return mutants


def _share_found(package: str, verdicts: Sequence[Verdict]) -> str:
    results: Counter[str] = Counter()
    for verdict in verdicts:
        if verdict.mutant.package == package:
            results[verdict.result] += 1
    found, unjudged = results["found"], results["unjudged"]
    share = f"{found} of {found + results['survived']} found"
    return f"{share}, {unjudged} unjudged" if unjudged else share


def main() -> int:
    """Judge mutants of some packages; print the survivors, and the share found in each package."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--package", nargs="+", default=PACKAGES, metavar="NAME")
    parser.add_argument("--count", type=int, default=10, help="mutants of each package")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--minutes", type=float, default=60.0, help="judge no more after this time")
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--json", type=Path, help="file for the verdicts")
    options = parser.parse_args()
    mutants = _mutants_in_turn(options.package, options.count, options.seed)
    with ProcessPoolExecutor(1, FORK) as helper:
        mutants = helper.submit(with_tests, mutants).result()
    prepare(are_many=True)
    verdicts: list[Verdict] = []
    for verdict in judged(mutants, workers=options.workers, seconds=60 * options.minutes):
        verdicts.append(verdict)
        if verdict.result == "found":
            continue
        sys.stdout.write(f"{verdict.result} {verdict.mutant}\n")
        sys.stdout.flush()
    for package in options.package:
        sys.stdout.write(f"{package}: {_share_found(package, verdicts)}\n")
    if options.json:
        rows = [asdict(verdict) for verdict in verdicts]
        options.json.write_text(json.dumps(rows, indent=1), "utf-8")
    return 0


if __name__ == "__main__":
    sys.exit(main())

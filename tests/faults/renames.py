"""Show that private names and layout are free: rename private functions in a copy of the tree.

    python tests/faults/renames.py [--count N] [--seed N] [--files N] [--list]

Ten private functions of the product, drawn at random, get other names, and one module another
layout. Then every planted fault must still fit, and the nearest tests must pass.
"""

import argparse
import ast
import os
import random
import re
import subprocess
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path

from copies import ROOT, sound_copy
from planting import is_private

sys.path.insert(0, str(ROOT / "tests" / "support"))
sys.path.insert(0, str(ROOT / "tests" / "programs"))
from packages import PACKAGES

FOREIGN = {name for name in dir(__import__("asyncio").Handle) if is_private(name)}
"""Names that libraries define and the product uses."""
TESTS = ("-q", "-x", "-p", "no:cacheprovider", "-m", "not long and not alone and not real_time")


def product_files(tree: Path) -> list[Path]:
    """Return the modules of the product in a tree."""
    return [path for package in PACKAGES for path in sorted((tree / package).rglob("*.py"))]


def private_functions(files: Sequence[Path]) -> Mapping[str, list[Path]]:
    """Return the names of private functions and methods, each with the files that define it.

    Names that occur in a text are left out: code that looks them up must change with them.
    """
    defined: dict[str, list[Path]] = {}
    in_texts: set[str] = set()
    for path in files:
        for node in ast.walk(ast.parse(path.read_text("utf-8"))):
            if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef) and is_private(node.name):
                defined.setdefault(node.name, []).append(path)
            elif isinstance(node, ast.Constant) and isinstance(node.value, str):
                in_texts.add(node.value)
    used = in_texts | FOREIGN
    return {name: paths for name, paths in sorted(defined.items()) if name not in used}


def rename(path: Path, names: Mapping[str, str]) -> None:
    """Rename in one module, in f-strings and docstrings as well."""
    text = path.read_text("utf-8")
    for old_name, new_name in names.items():
        text = re.sub(rf"\b{old_name}\b", new_name, text)
    path.unlink()  # it may be a hard link
    path.write_text(text, "utf-8")


def reformat(path: Path) -> None:
    """Give a module short lines and single quotes."""
    options = ["--line-length", "60", "--config", "format.quote-style='single'"]
    subprocess.run([sys.executable, "-m", "ruff", "format", "-q", *options, path], check=True)


def nearest_tests(files: Sequence[str], count: int) -> list[str]:
    """Return the test files nearest to some modules, some for each of them."""
    from changed_tests import nearest  # takes a second to import

    selected: dict[str, None] = {}
    for file in files:
        selected.update(dict.fromkeys([*nearest([file])][:count]))
    return list(selected)


def main() -> int:
    """Rename, reformat, check the faults and run the tests; return 1 if anything fails."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--count", type=int, default=10, help="private functions to rename")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--files", type=int, default=2, help="test files for each module")
    parser.add_argument("--list", action="store_true", help="list the choice, and run nothing")
    options = parser.parse_args()
    draw = random.Random(options.seed)
    functions = private_functions(product_files(ROOT))
    selected = draw.sample(sorted(functions), options.count)
    module = draw.choice(product_files(ROOT)).relative_to(ROOT).as_posix()
    files = {path.relative_to(ROOT).as_posix() for name in selected for path in functions[name]}
    sys.stdout.write(f"renamed: {', '.join(selected)}\nreformatted: {module}\n")
    if options.list:
        return 0
    tests = nearest_tests(sorted(files | {module}), options.files)
    with sound_copy() as tree:
        for path in product_files(tree):
            rename(path, {name: f"{name}_renamed" for name in selected})
        reformat(tree / module)
        environment = {**os.environ, "PYTHONPATH": str(tree)}
        check = [sys.executable, "tests/faults/run.py", "--check"]
        pytest = [sys.executable, "-m", "pytest", *TESTS, *tests]
        statuses = []
        for command in (check, pytest):
            done = subprocess.run(command, cwd=tree, env=environment, check=False)
            statuses.append(done.returncode)
    sys.stdout.write(f"faults: status {statuses[0]}; {len(tests)} test files: {statuses[1]}\n")
    return 1 if any(statuses) else 0


if __name__ == "__main__":
    sys.exit(main())

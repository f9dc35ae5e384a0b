"""Compilation of C sources to a library, by the compiler of the machine."""

import os
import shutil
import subprocess
import tempfile
from collections.abc import Iterable, Sequence
from pathlib import Path

from model.errors import InputError

_COMPILERS = ("cc", "gcc", "clang")
_TIMEOUT = 120.0  # s


def compile_library(
    path: Path, sources: Iterable[Path], *, flags: Sequence[str], what: str
) -> None:
    """Compile C sources to a shared library; what: its name in messages. Raises InputError."""
    compiler = os.environ.get("CC") or next(filter(shutil.which, _COMPILERS), None)
    if compiler is None or not shutil.which(compiler.split()[0]):
        raise InputError(
            f"{what} is compiled at first use and there is no C compiler "
            f"({compiler or ', '.join(_COMPILERS)}); install one (Debian: apt install gcc "
            "libc6-dev; macOS: xcode-select --install)"
        )
    # Of its own, since threads and processes may compile the same at once.
    with tempfile.TemporaryDirectory(prefix=".", dir=path.parent) as folder:
        made = Path(folder) / path.name
        _compile(made, compiler.split(), sources, flags=flags, what=what)
        with made.open("rb") as file:
            os.fsync(file.fileno())  # a name must not outlive a power failure without its content
        made.replace(path)


def _compile(
    made: Path,
    compiler: Sequence[str],
    sources: Iterable[Path],
    *,
    flags: Sequence[str],
    what: str,
) -> None:
    files = map(str, (made, *sorted(sources)))
    command = [*compiler, *flags, "-fPIC", "-shared", "-o", *files, "-lm"]
    try:
        done = subprocess.run(  # noqa: S603  the user's compiler
            command, capture_output=True, text=True, timeout=_TIMEOUT, check=False
        )
    except subprocess.TimeoutExpired:
        raise InputError(
            f"{what} must be compiled within {_TIMEOUT:g} s, got no end of {' '.join(compiler)}; "
            "set CC to another compiler"
        ) from None
    if done.returncode:
        lines = done.stderr.strip().splitlines() or ["no message"]
        first = next((line for line in lines if "error" in line), lines[0])
        raise InputError(
            f"{what} could not be compiled by {' '.join(compiler)}: {first}; install the C headers "
            "(Debian: apt install gcc libc6-dev)"
        )

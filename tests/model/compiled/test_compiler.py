"""Compilers that are not there, fail, or do not end, and several that compile the same."""

import ctypes
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest

from model.compiled import compiler
from model.compiled.compiler import compile_library
from model.errors import InputError


@pytest.fixture
def source(tmp_path: Path) -> Path:
    """Of a function that returns seven."""
    path = tmp_path / "seven.c"
    path.write_text("int seven(void) { return 7; }")
    return path


@pytest.mark.parametrize("cc", ["/nowhere/cc", "false", "sleep 60 #"])
def test_compiler_that_gives_no_library_is_bad_input(
    cc: str, source: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Neither is there a file then, nor a part of one."""
    monkeypatch.setenv("CC", cc)
    monkeypatch.setattr(compiler, "_TIMEOUT", 0.01)
    with pytest.raises(InputError):
        compile_library(tmp_path / "seven.so", [source], flags=(), what="seven")
    assert [path.name for path in tmp_path.iterdir()] == ["seven.c"]


def test_threads_compile_the_same_at_once(source: Path, tmp_path: Path) -> None:
    """Each in a folder of its own, so that no thread loads a part of the library."""
    path = tmp_path / "seven.so"

    def load(_: int) -> int:
        compile_library(path, [source], flags=(), what="seven")
        return int(ctypes.CDLL(str(path)).seven())

    with ThreadPoolExecutor(4) as pool:
        assert list(pool.map(load, range(4))) == [7] * 4
    assert {each.name for each in tmp_path.iterdir()} == {"seven.c", "seven.so"}

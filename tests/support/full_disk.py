"""A disk that is full, as a process sees it."""

import contextlib
import resource
import sys
from collections.abc import Iterator


@contextlib.contextmanager
def full_disk(*, at: int = 1024) -> Iterator[None]:
    """No file may become longer than so many bytes: what is written beyond raises OSError.

    Python writes no bytecode meanwhile: it does not notice that a file was cut off, and later
    imports of the module fail.
    """
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    writes_none = sys.dont_write_bytecode
    sys.dont_write_bytecode = True
    resource.setrlimit(resource.RLIMIT_FSIZE, (at, before[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
        sys.dont_write_bytecode = writes_none

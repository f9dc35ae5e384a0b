"""What only POSIX systems have: locks on files, and a sentence where its modules are missing.

Wires, daemon, clients and gateway need it; the plate, its tables, answers and designs do not.
"""

from typing import IO, Any

_MODULES = frozenset(("fcntl", "pwd", "resource", "termios", "tty"))


def lock(file: IO[Any]) -> None:
    """Lock an open file, until it is closed or its process ends, however it ends.

    Raises BlockingIOError if it is locked already, OSError if its file system does not lock.
    """
    import fcntl

    fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)


def posix_needed(error: BaseException) -> str | None:
    """What to do about a missing module of POSIX systems; None for every other error."""
    if not isinstance(error, ModuleNotFoundError) or error.name not in _MODULES:
        return None
    return f"wires, daemon and clients need Linux or macOS (no module {error.name} here); use WSL"

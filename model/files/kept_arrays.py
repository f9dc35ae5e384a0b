"""Arrays kept in files, so that interrupted work can be resumed.

Each file has a SHA-256 over its arrays and over a text that identifies them.
"""

import logging
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from model.files.array_file import UNREADABLE, Arrays, digest_of, read_arrays, write_arrays

MAX_BYTES = 1 << 30

_logger = logging.getLogger(__name__)


def keep_arrays(path: Path, text: str, arrays: Arrays) -> None:
    """Write arrays identified by a text, atomically; raises OSError."""
    path.parent.mkdir(parents=True, exist_ok=True)
    write_arrays(path, {**arrays, "sha256": _digest(text, arrays)})


def kept_arrays(path: Path, text: str, types: Mapping[str, str]) -> dict[str, NDArray[Any]] | None:
    """Read arrays of these names and types (`dtype.str`), identified by a text.

    None if there are none, or, with a warning, if they are damaged.
    """
    try:
        arrays = read_arrays(path, {**types, "sha256": "|u1"}, max_bytes=MAX_BYTES)
    except FileNotFoundError:
        return None
    except UNREADABLE as error:
        _logger.warning("%s: unreadable, computed again: %s", path, error)
        return None
    digest = arrays.pop("sha256")
    if not np.array_equal(digest, _digest(text, arrays)):
        _logger.warning("%s: damaged, computed again", path)
        return None
    return arrays


def _digest(text: str, arrays: Arrays) -> NDArray[np.uint8]:
    return np.frombuffer(digest_of(text, arrays).encode(), dtype=np.uint8)

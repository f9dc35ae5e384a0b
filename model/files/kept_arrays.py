"""Arrays kept in a folder, so that what was interrupted goes on: found again whole, or not at all.

Each file carries a SHA-256 over its arrays and over the text that they were kept under, so that
neither a flipped bit passes nor the arrays of something else.
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
    """Keep arrays; their file is whole or not there. Raises OSError if it cannot be written."""
    path.parent.mkdir(parents=True, exist_ok=True)
    write_arrays(path, {**arrays, "sha256": _digest(text, arrays)})


def kept_arrays(path: Path, text: str, types: Mapping[str, str]) -> dict[str, NDArray[Any]] | None:
    """Arrays of these names and types (numpy's `dtype.str`) that were kept under a text, or None.

    A damaged file is told of and taken for none.
    """
    try:
        arrays = read_arrays(path, {**types, "sha256": "|u1"}, max_bytes=MAX_BYTES)
    except FileNotFoundError:
        return None
    except UNREADABLE as error:
        _logger.warning("%s cannot be read and is computed again: %s", path, error)
        return None
    digest = arrays.pop("sha256")
    if not np.array_equal(digest, _digest(text, arrays)):
        _logger.warning("%s is damaged and is computed again", path)
        return None
    return arrays


def _digest(text: str, arrays: Arrays) -> NDArray[np.uint8]:
    return np.frombuffer(digest_of(text, arrays).encode(), dtype=np.uint8)

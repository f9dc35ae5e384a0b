"""The cache folder of tables, and the versions that results carry."""

import hashlib
from functools import cache
from importlib import metadata, resources
from pathlib import Path

import platformdirs


def cache_folder() -> Path:
    """Path of the user's cache folder; raises FileNotFoundError for a user without a home."""
    try:
        folder = platformdirs.user_cache_path("era-haptics", appauthor=False)
    except RuntimeError:  # neither HOME nor an entry in passwd
        folder = Path()
    if folder.is_absolute():
        return folder
    raise FileNotFoundError(
        "a cache folder needs a home folder, which this user lacks; set HOME or XDG_CACHE_HOME"
    )


NUMERICS_VERSION = 23
"""Version of the numbers that the model computes: kept results of another one are not reused.

Increase it with every change of figures beyond rounding, then record the new figures by
`python tests/support/reference_figures.py`.
"""


@cache
def code_version() -> str:
    """The version of the distribution and the start of a SHA-256 over the source of the model."""
    digest = hashlib.sha256()
    pending = [resources.files("model")]
    while pending:
        for entry in sorted(pending.pop().iterdir(), key=lambda entry: entry.name):
            if entry.is_dir():
                pending.append(entry)
            elif entry.name.endswith((".py", ".c", ".h")):
                digest.update(entry.read_bytes())
    return f"{metadata.version('era-haptics')}+{digest.hexdigest()[:12]}"

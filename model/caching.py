"""Cache folder of tables, and the versions that results contain."""

import hashlib
from functools import cache
from importlib import metadata, resources
from pathlib import Path

import platformdirs


def cache_folder() -> Path:
    """Return the user's cache folder; raises FileNotFoundError without a home folder."""
    try:
        folder = platformdirs.user_cache_path("era-haptics", appauthor=False)
    except RuntimeError:  # neither HOME nor an entry in passwd
        folder = Path()
    if folder.is_absolute():
        return folder
    raise FileNotFoundError(
        "a cache folder needs a home folder, which this user lacks; set HOME or XDG_CACHE_HOME"
    )


NUMERICS_VERSION = 25
"""Version of the numbers that the model computes; stored results of other versions are not used.

Increase it with every change of figures beyond rounding. Then record the new figures with
`python tests/programs/reference_figures.py`.
"""


@cache
def code_version() -> str:
    """Return the version of the distribution and the start of the SHA-256 of the model's source."""
    digest = hashlib.sha256()
    pending = [resources.files("model")]
    while pending:
        for entry in sorted(pending.pop().iterdir(), key=lambda entry: entry.name):
            if entry.is_dir():
                pending.append(entry)
            elif entry.name.endswith((".py", ".c", ".h")):
                digest.update(entry.read_bytes())
    return f"{metadata.version('era-haptics')}+{digest.hexdigest()[:12]}"

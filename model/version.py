"""By which code a result was made, so that what other code has made is not taken for it."""

import hashlib
from functools import cache
from importlib import metadata, resources


@cache
def code_version() -> str:
    """Version of the distribution, and the beginning of a SHA-256 over the source of the model."""
    digest = hashlib.sha256()
    pending = [resources.files("model")]
    while pending:
        for entry in sorted(pending.pop().iterdir(), key=lambda entry: entry.name):
            if entry.is_dir():
                pending.append(entry)
            elif entry.name.endswith(".py"):
                digest.update(entry.read_bytes())
    return f"{metadata.version('era-haptics')}+{digest.hexdigest()[:12]}"

"""The dashboard's token in a file, where printing it would put it into a log."""

import os
import secrets
from pathlib import Path

from model.errors import InputError


def write_token(file: Path) -> Path:
    """Write a new random token to a file that only its owner may read; raises InputError."""
    try:
        file.unlink(missing_ok=True)
        with open(file, "x", opener=lambda name, flags: os.open(name, flags, 0o600)) as stream:
            stream.write(f"{secrets.token_urlsafe(32)}\n")
    except OSError as error:
        raise InputError(f"{file}: cannot write the dashboard's token: {error.strerror}") from error
    return file

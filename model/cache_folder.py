"""The folder of what is kept between runs: tables, and the compiled library of kernels."""

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
        "a cache folder needs a home folder, and this user has none; set HOME or XDG_CACHE_HOME"
    )

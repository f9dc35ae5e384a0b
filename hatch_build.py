"""Build hook: compiles the engine of `era soft-amp` into wheels of one platform.

Plain wheels hold its C sources, which are compiled at first use; with the environment variable
ERA_HAPTICS_ENGINE=1 a wheel holds the engine, too, and is tagged with the platform.
"""

import os
import sys
import tempfile
from pathlib import Path
from typing import Any

from hatchling.builders.hooks.plugin.interface import BuildHookInterface
from packaging.tags import platform_tags


class EngineHook(BuildHookInterface):  # type: ignore[type-arg]
    """Adds the engine to a wheel; `make dist-platform` asks for it."""

    def initialize(self, version: str, build_data: dict[str, Any]) -> None:
        """Compile and include it."""
        if os.environ.get("ERA_HAPTICS_ENGINE") != "1" or version == "editable":
            return
        sys.path.insert(0, self.root)
        try:
            from sim.soft_amp.library import ENGINE, compile_engine
        finally:
            sys.path.pop(0)
        self._folder = tempfile.TemporaryDirectory(prefix="era-engine-")
        made = Path(self._folder.name) / ENGINE
        compile_engine(made)
        build_data["force_include"][str(made)] = f"sim/soft_amp/{ENGINE}"
        build_data["pure_python"] = False
        build_data["tag"] = f"py3-none-{next(platform_tags())}"

    def finalize(self, version: str, build_data: dict[str, Any], artifact_path: str) -> None:
        """Remove what was compiled."""
        if hasattr(self, "_folder"):
            self._folder.cleanup()

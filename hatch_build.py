"""Build hook: compiles what is in C into wheels of one platform.

That is the engine of `era soft-amp`, which needs POSIX threads, and the kernels of `model`. Plain
wheels hold the C sources, which are compiled at first use; with the environment variable
ERA_HAPTICS_ENGINE=1 a wheel holds the libraries, too, and is tagged with the platform.
"""

import os
import sys
import sysconfig
import tempfile
from pathlib import Path
from typing import Any

from hatchling.builders.hooks.plugin.interface import BuildHookInterface
from packaging.tags import platform_tags

IS_WANTED = os.environ.get("ERA_HAPTICS_ENGINE") == "1"


class EngineHook(BuildHookInterface):  # type: ignore[type-arg]
    """Adds the libraries to a wheel; `make dist-platform` asks for it."""

    def dependencies(self) -> list[str]:
        """What the modules that compile them import."""
        return ["numpy>=2.2", "platformdirs>=4.0"] if IS_WANTED else []

    def initialize(self, version: str, build_data: dict[str, Any]) -> None:
        """Compile and include them."""
        if not IS_WANTED or version == "editable":
            return
        sys.path.insert(0, self.root)
        try:
            from model.compiled.kernels import compile_kernels
            from sim.soft_amp.engine import ENGINE, compile_engine
        finally:
            sys.path.pop(0)
        self._folder = tempfile.TemporaryDirectory(prefix="era-engine-")
        folder = Path(self._folder.name)
        made = {"model/compiled": compile_kernels(folder)}
        if os.name == "posix":
            compile_engine(folder / ENGINE)
            made["sim/soft_amp"] = [folder / ENGINE]
        for where, paths in made.items():
            for path in paths:
                build_data["force_include"][str(path)] = f"{where}/{path.name}"
        build_data["pure_python"] = False
        build_data["tag"] = f"py3-none-{_platform()}"

    def finalize(self, version: str, build_data: dict[str, Any], artifact_path: str) -> None:
        """Remove the folder in which they were compiled."""
        if hasattr(self, "_folder"):
            self._folder.cleanup()


def _platform() -> str:
    """The platform of a wheel's tag: on Linux the C library's, on macOS the oldest it is for."""
    if sys.platform == "linux":
        return next(tag for tag in platform_tags() if not tag.startswith("linux_"))
    return sysconfig.get_platform().replace("-", "_").replace(".", "_")

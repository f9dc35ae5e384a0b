"""Build hook: compiles the C libraries (`build_libraries.py`).

A wheel contains the libraries for all processors of its platform, and its tag names the platform.
An editable installation gets those for this processor, in its tree. Without a C compiler, the wheel
is pure Python, and answers are computed by numpy.
"""

import sys
import sysconfig
import tempfile
from pathlib import Path
from typing import Any

from hatchling.builders.hooks.plugin.interface import BuildHookInterface
from packaging.tags import platform_tags


class LibraryHook(BuildHookInterface):  # type: ignore[type-arg]
    """Adds the compiled libraries to a wheel or to the tree of an editable installation."""

    def initialize(self, version: str, build_data: dict[str, Any]) -> None:
        """Compile the libraries."""
        sys.path.insert(0, self.root)
        try:
            import build_libraries
        finally:
            sys.path.remove(self.root)
        try:
            if version == "editable":
                build_libraries.update(build_libraries.tree_libraries())
                return
            self._folder = tempfile.TemporaryDirectory(prefix="era-libraries-")
            compiled = {}
            for library in build_libraries.wheel_libraries():
                path = Path(self._folder.name) / Path(library.file).name
                build_libraries.compile_library(library, path)
                compiled[str(path)] = library.file
        except build_libraries.BuildError as error:
            self.app.display_warning(f"era-haptics is built without C libraries: {error}")
            return
        build_data["force_include"].update(compiled)
        build_data["pure_python"] = False
        build_data["tag"] = f"py3-none-{_platform()}"

    def finalize(self, version: str, build_data: dict[str, Any], artifact_path: str) -> None:
        """Remove the temporary folder."""
        if hasattr(self, "_folder"):
            self._folder.cleanup()


def _platform() -> str:
    """Return the platform in a wheel's tag: C library and its version, or the oldest macOS."""
    if sys.platform == "linux":
        for tag in platform_tags():
            if not tag.startswith("linux_"):  # which no package index takes
                return tag
    return sysconfig.get_platform().replace("-", "_").replace(".", "_")

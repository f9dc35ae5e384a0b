"""Stands in for pip where a reader installs an example: what was built before is copied.

python built_pip.py BUILT SITE install FOLDER
python built_pip.py BUILT SITE uninstall -y NAME
"""

import shutil
import sys
import tomllib
from importlib.metadata import Distribution
from pathlib import Path


def _found(name: str, folder: Path) -> Distribution:
    (distribution,) = Distribution.discover(name=name, path=[str(folder)])
    return distribution


def _main(built: Path, site: Path, verb: str, *words: str) -> None:
    if verb == "install":
        project = tomllib.loads((Path(words[0]) / "pyproject.toml").read_text("utf-8"))["project"]
        for file in _found(project["name"], built).files or []:
            (site / file).parent.mkdir(parents=True, exist_ok=True)
            shutil.copy(built / file, site / file)
        sys.stdout.write(f"Successfully installed {project['name']}-{project['version']}\n")
    else:
        distribution = _found(words[-1], site)
        version = distribution.version
        for file in distribution.files or []:
            (site / file).unlink(missing_ok=True)
        sys.stdout.write(f"  Successfully uninstalled {words[-1]}-{version}\n")


if __name__ == "__main__":
    _main(Path(sys.argv[1]), Path(sys.argv[2]), *sys.argv[3:])

"""The `era` command in another process that takes its code for that of this one.

What is kept is kept under a digest of the source, and the source may be edited while tests run: a
process that starts later would find nothing of what another has kept, and be right.
"""

from model.version import code_version


def era_program() -> str:
    """A program text for `python -c`."""
    return (
        "import sys; from model import version; "
        f"version.code_version = lambda: {code_version()!r}; "
        "from controller.cli.main import main; sys.exit(main())"
    )

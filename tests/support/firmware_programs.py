"""The firmware, built by the compiler of this machine, and its programs."""

import subprocess
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

FIRMWARE = Path(__file__).parents[2] / "firmware"


def build_firmware(folder: Path, program: str, *options: str) -> Path:
    """Build one of its programs into a folder, with options of make; return the folder.

    Not optimised: compiling takes longer than all that tests play.
    """
    goal = folder / program
    command = ["make", "-s", "-C", FIRMWARE, f"OUT={folder}", "CFLAGS=-O0", *options, goal]
    subprocess.run(command, check=True)
    return folder


@contextmanager
def running_firmware(folder: Path, *options: str) -> Iterator[tuple[str, int]]:
    """Run the amplifier with an option for its line; yield the URL of that line, and its process.

    The process is given by its number.
    """
    with subprocess.Popen(
        [folder / "era-firmware", "--until-eof", *options],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
    ) as process:
        assert process.stdin is not None
        assert process.stdout is not None
        yield process.stdout.readline().strip(), process.pid
        process.stdin.close()

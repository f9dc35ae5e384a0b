"""Prove the firmware: `python firmware/test/run.py [--long] [--no-tests]`, by `make firmware-test`.

Runs its tests, among them the check of its sources (`sources.py`), then that of damaged frames
under the sanitizers of addresses and of undefined behaviour (20 000 for each line; 200 000 with
--long). Prints the sizes of the port to a Cortex-M3, for QEMU and as configured for a
board, or that its compiler is not installed, which is a failure in CI. --no-tests: after
`make test`, which has run them.
"""

import os
import shutil
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).parents[2]
OUT = ROOT / "out" / "firmware"
DAMAGED = "tests/firmware/test_firmware.py"


def main() -> None:
    """Run everything; the first failure ends it."""
    frames = 200_000 if "--long" in sys.argv else 20_000
    run("make", "-s", "-C", ROOT / "firmware", f"OUT={OUT}", "all")
    if "--no-tests" not in sys.argv:
        run(sys.executable, "-m", "pytest", "-q", "tests/firmware", cwd=ROOT)
    library = subprocess.check_output(["cc", "-print-file-name=libasan.so"], text=True).strip()
    os.environ |= {"LD_PRELOAD": library, "ASAN_OPTIONS": "detect_leaks=0"}  # of this interpreter
    os.environ |= {"SANITIZERS": "address,undefined", "FRAMES": str(frames)}
    run(sys.executable, "-m", "pytest", "-q", DAMAGED, cwd=ROOT)
    del os.environ["LD_PRELOAD"]
    if not shutil.which("arm-none-eabi-gcc"):
        print("left out: bare metal; it needs gcc-arm-none-eabi and libnewlib-arm-none-eabi")
        sys.exit(os.environ.get("CI") == "true")
    run("arm-none-eabi-size", *sorted(OUT.glob("era-firmware-*.elf")))


def run(*command: str | Path, cwd: Path | None = None) -> None:
    """Run a command and show its output; end with its status if it fails."""
    print("$", *(str(part).removeprefix(f"{ROOT}{os.sep}") for part in command), flush=True)
    status = subprocess.run(command, cwd=cwd, check=False).returncode
    if status != 0:
        sys.exit(status)


if __name__ == "__main__":
    main()

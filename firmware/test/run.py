"""Prove the firmware: `python firmware/test/run.py [--long] [--no-tests]`, by `make firmware-test`.

Runs the tests of its samples, mutated frames under the sanitizers (20 000 for each codec; a million
with --long), and conformance on every wire. Prints code size, memory, and instructions per frame
and per sample, and says what was left out where a program is not installed, which is a failure in
CI. --no-tests: after `make test`, which has run them.
"""

import os
import shutil
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).parents[2]
OUT = ROOT / "out" / "firmware"
TESTS = ("tests/firmware/test_firmware_samples.py", "tests/firmware/test_firmware_on_the_plate.py")


def main() -> None:
    """Run everything; the first failure ends it."""
    frames = 1_000_000 if "--long" in sys.argv else 20_000
    is_bare_metal = shutil.which("arm-none-eabi-gcc") and shutil.which("qemu-system-arm")
    run("make", "-s", "-C", ROOT / "firmware", f"OUT={OUT}", "all", OUT / "era-fuzz")
    if "--no-tests" not in sys.argv:
        run(sys.executable, "-m", "pytest", "-q", *TESTS, cwd=ROOT)
    run(OUT / "era-fuzz", str(frames))
    run(sys.executable, ROOT / "firmware" / "test" / "conformance.py")
    if not is_bare_metal:
        print("left out: bare metal; it needs gcc-arm-none-eabi and qemu-system-arm")
        sys.exit(os.environ.get("CI") == "true")
    run("arm-none-eabi-size", OUT / "mps2-amplifier.elf")
    print(instructions(), end="")


def run(*command: str | Path, cwd: Path | None = None) -> None:
    """Run a command and show its output; end with its status if it fails."""
    print("$", *(str(part).removeprefix(f"{ROOT}{os.sep}") for part in command), flush=True)
    status = subprocess.run(command, cwd=cwd, check=False).returncode
    if status != 0:
        sys.exit(status)


def instructions() -> str:
    """What test/bench.c prints, in QEMU with an instruction each nanosecond."""
    machine = ["qemu-system-arm", "-M", "mps2-an385", "-display", "none", "-monitor", "none"]
    kernel = ["-icount", "shift=0", "-kernel", OUT / "mps2-bench.elf", "-serial", "stdio"]
    with subprocess.Popen([*machine, *kernel], stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        lines = ["instructions of a Cortex-M3:\n"]
        while (line := process.stdout.readline()) not in ("end\n", ""):
            lines.append(f"  {line}")
        process.terminate()
    return "".join(lines)


if __name__ == "__main__":
    main()

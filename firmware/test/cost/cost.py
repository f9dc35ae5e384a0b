"""Cost of the firmware on Arm processors: `make -C firmware cost`.

Builds `cost.c` for each core and configuration, runs it in QEMU instruction by instruction, and
adds up cycles from the tables of Arm's technical reference manuals. Flash has no wait states, and
the stack excludes interrupts. Fails if a processor does not carry its configuration with all voices
on their ramps, starts a set later than 2 ms, or makes no sample for longer than its buffer lasts.
"""

import re
import subprocess
import sys
import tempfile
from collections import defaultdict
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import NamedTuple

FIRMWARE = Path(__file__).parents[2]
LINE = re.compile(r"\s*([0-9a-f]+):\s+(\S+)\s*(.*)")
SYMBOL = re.compile(r"^([0-9a-f]+) <([^>]+)>:", re.MULTILINE)
REGISTERS = re.compile(r"\{(.*?)\}")
RANGE = re.compile(r"\s*r(\d+)-r(\d+)")
PRINTED = re.compile(r"(\w+)=(\d+)")
LONG_PRODUCTS = ("smull", "umull", "smlal", "umlal")
OPTIMIZATION = "-O2"


class Core(NamedTuple):
    """A processor: options of the compiler, machine of QEMU that runs its instructions, cycles."""

    cpu: str
    machine: str
    branch: int
    """Cycles of a taken branch."""
    long_product: int
    product_sum: int
    """Cycles of a multiplication to 64 bits, and with an addition to 32 bits."""


CORES = {
    "M0+": Core("cortex-m0plus", "mps2-an385", 2, 0, 0),
    "M3": Core("cortex-m3", "mps2-an385", 3, 5, 2),
    "M4, M33": Core("cortex-m4", "mps2-an386", 3, 1, 1),
}


class Instruction(NamedTuple):
    """An instruction: its cycles, if the next one is executed and if not."""

    following: frozenset[int]
    cycles: int
    branch_cycles: int


class Work(NamedTuple):
    """Instructions and cycles of a piece of work."""

    instructions: int
    cycles: int


class Program(NamedTuple):
    """A program that was built: its file, and its size [bytes]."""

    elf: Path
    flash: int
    ram: int


def built(core: Core, options: list[str], folder: Path, sources: list[Path]) -> Program:
    """Build a program with options of the compiler."""
    elf = folder / "cost.elf"
    link = FIRMWARE / "ports" / "cortex-m" / "link.ld"
    includes = [f"-I{FIRMWARE / name}" for name in ("core", "wire", "ports/cortex-m")]
    command = ["arm-none-eabi-gcc", "-std=c99", f"-mcpu={core.cpu}", "-mthumb", OPTIMIZATION]
    command += ["-ffunction-sections", "-fdata-sections", "--specs=nano.specs", "-nostartfiles"]
    command += ["-Wl,--gc-sections", "-T", str(link), *includes, *options]
    subprocess.run([*command, *sources, "-o", elf], check=True)
    size = subprocess.check_output(["arm-none-eabi-size", elf], text=True)
    text, data, bss = map(int, size.splitlines()[1].split()[:3])
    return Program(elf, text + data, data + bss)


def sources_of(program: str) -> list[Path]:
    """Return the sources of the port, or of the measuring program."""
    core = sorted((FIRMWARE / "core").glob("*.c"))
    wire = sorted((FIRMWARE / "wire").glob("*.c"))
    port = FIRMWARE / "ports" / "cortex-m"
    if program == "port":
        return [*core, *wire, *sorted(port.glob("*.c"))]
    parts = [path for path in core if path.name != "loop.c"]
    parts += [path for path in wire if path.stem in ("messages", "crc", "serial")]
    parts += [port / name for name in ("start.c", "stack.c", "lines.c")]
    return [*parts, FIRMWARE / "test" / "cost" / "cost.c"]


def disassembled(elf: Path, core: Core) -> tuple[dict[int, Instruction], dict[int, str]]:
    """Return the instructions and the symbols of a program by address."""
    command = ["arm-none-eabi-objdump", "-d", "--no-show-raw-insn", elf]
    text = subprocess.check_output(command, text=True)
    instructions = {}
    for line in text.splitlines():
        match = LINE.match(line)
        if match:
            address = int(match[1], 16)
            following = frozenset((address + 2, address + 4))
            operation = match[2].split(".")[0]
            cycles, branch_cycles = cycles_of(operation, match[3], core)
            instructions[address] = Instruction(following, cycles, branch_cycles)
    symbols = {int(match[1], 16): match[2] for match in SYMBOL.finditer(text)}
    return instructions, symbols


def cycles_of(operation: str, operands: str, core: Core) -> tuple[int, int]:
    """Return the cycles of an instruction, if the next one is executed and if not."""
    count = register_count(operands)
    refill = core.branch
    if operation in ("push", "stmdb", "stmia", "stm"):
        return 1 + count, 1 + count
    if operation in ("pop", "ldmia", "ldm", "ldmdb"):
        return 1 + count, 1 + count + refill
    if operation in ("ldrd", "strd"):
        return 3, 3
    if operation.startswith("ldr"):
        return 2, 2 + refill
    if operation.startswith("str"):
        return 2, 2
    if operation in LONG_PRODUCTS:
        return core.long_product, core.long_product
    if operation in ("mla", "mls"):
        return core.product_sum, core.product_sum
    if operation in ("udiv", "sdiv"):
        return 8, 8  # 2 to 12
    if operation in ("bl", "blx"):
        return 3, 3
    return 1, refill


def register_count(operands: str) -> int:
    """Return the number of registers in braces."""
    match = REGISTERS.search(operands)
    if not match:
        return 0
    count = 0
    for part in match[1].split(","):
        limits = RANGE.match(part)
        count += int(limits[2]) - int(limits[1]) + 1 if limits else 1
    return count


def traced(elf: Path, core: Core, output: Path) -> Iterator[int]:
    """Run a program and yield the address of each instruction; output: file for its UART."""
    command = ["qemu-system-arm", "-M", core.machine, "-display", "none", "-monitor", "none"]
    command += ["-serial", f"file:{output}", "-singlestep", "-d", "exec,nochain"]
    with subprocess.Popen([*command, "-kernel", elf], stderr=subprocess.PIPE) as process:
        try:
            for line in process.stderr:
                if line.startswith(b"Trace"):
                    yield int(line.split(b"/", 2)[1], 16)
        finally:
            process.kill()


def measured(elf: Path, core: Core, output: Path) -> tuple[dict[str, Work], dict[str, int]]:
    """Return the longest work of each name, and the numbers that the program prints."""
    instructions, symbols = disassembled(elf, core)
    addresses = {name: address for address, name in symbols.items()}
    begin, end = addresses["work_begins"], addresses["work_ends"]
    finish = addresses["finish"]
    works: list[Work] = []
    is_counted = False
    count = cycles = 0
    last: Instruction | None = None
    for address in traced(elf, core, output):
        if is_counted and last is not None:
            count += 1
            cycles += last.cycles if address in last.following else last.branch_cycles
        last = instructions.get(address)
        if address == begin:
            is_counted = True
            count = cycles = 0
        elif address == end:
            works.append(Work(count, cycles))
            is_counted = False
        elif address == finish:
            break
    printed = output.read_text().splitlines()
    names = [line for line in printed if "=" not in line]
    longest: dict[str, Work] = defaultdict(lambda: Work(0, 0))
    for name, work in zip(names, works, strict=True):
        longest[name] = max(longest[name], work, key=lambda each: each.cycles)
    numbers = {match[1]: int(match[2]) for match in map(PRINTED.fullmatch, printed) if match}
    return dict(longest), numbers


class Configuration(NamedTuple):
    """Options of the compiler, the cores to measure, and processors that must carry it."""

    options: Mapping[str, int]
    cores: tuple[str, ...]
    processors: tuple[str, ...] = ()


class Processor(NamedTuple):
    """A processor: its core and clock rate [Hz]."""

    core: str
    clock_rate: float


PROCESSORS = {
    "RP2350": Processor("M4, M33", 150e6),
    "STM32G4": Processor("M4, M33", 170e6),
    "RP2040": Processor("M0+", 133e6),
}
LARGE = {"CHANNELS": 4, "LAYERS": 8, "VOICES": 16, "STREAM_WORDS": 1024}
CONFIGURATIONS = (
    Configuration({}, ("M3", "M4, M33"), ("RP2350", "STM32G4")),
    Configuration({"CHANNELS": 1, "SAMPLE_RATE": 8000}, ("M0+",), ("RP2040",)),
    Configuration({"CHANNELS": 1}, tuple(CORES)),
    Configuration({"CHANNELS": 4}, tuple(CORES)),
    Configuration(LARGE, tuple(CORES)),
)
DEFAULTS = {"CHANNELS": 2, "LAYERS": 4, "VOICES": 8, "SAMPLE_RATE": 16000}
"""Values of `core/config.h`."""
HEAD = """\
| channels, layers, voices, kHz | core | flash, RAM, stack [kB] \
| cycles of a sample: silent, 4 layers, all voices on ramps \
| kcycles of a Ping: silent, all voices | kcycles of a set | MHz |
|---|---|---|---|---|---|---|
"""
SAMPLES_AHEAD = 0.5e-3  # s; in the converter's buffer
MAX_SET_TIME = 2e-3  # s; from the last byte to the start
MAX_LOAD = 0.9
SETS = ("Set on full pools", "start of a set at a moment")
REQUESTS = ("Ping with full pools", "Set on full pools", "Commit", "Silence")


class Cost(NamedTuple):
    """Measured cost of a configuration on a core."""

    flash: int
    ram: int
    stack: int
    works: Mapping[str, Work]

    @property
    def set_cycles(self) -> int:
        """Cycles of the longest start of a set."""
        return max(self.works[name].cycles for name in SETS)

    @property
    def request_cycles(self) -> int:
        """Cycles of the longest request."""
        return max(self.works[name].cycles for name in REQUESTS)

    @property
    def sample_cycles(self) -> int:
        """Cycles of the longest sample."""
        return self.works["sample of full pools"].cycles


def cost_of(configuration: Configuration, core: Core) -> Cost:
    """Measure a configuration on a core."""
    options = [f"-D{name}={value}" for name, value in configuration.options.items()]
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        port = built(core, options, folder, sources_of("port"))
        program = built(core, options, folder, sources_of("cost"))
        works, numbers = measured(program.elf, core, folder / "uart")
    return Cost(port.flash, port.ram, numbers["stack"], works)


def row_of(configuration: Configuration, core_name: str, cost: Cost) -> str:
    """Return a row of the table."""
    values = {**DEFAULTS, **configuration.options}
    rate = values["SAMPLE_RATE"] / 1000
    works = cost.works
    samples = [works[f"sample {name}"].cycles for name in ("in silence", "of 4 layers")]
    samples.append(cost.sample_cycles)
    pings = [works[f"Ping {name}"].cycles / 1000 for name in ("in silence", "with full pools")]
    sizes = [size / 1000 for size in (cost.flash, cost.ram, cost.stack)]
    cells = [
        f"{values['CHANNELS']}, {values['LAYERS']}, {values['VOICES']}, {rate:.0f}",
        core_name,
        ", ".join(f"{size:.1f}" for size in sizes),
        ", ".join(str(cycles) for cycles in samples),
        ", ".join(f"{cycles:.0f}" for cycles in pings),
        f"{cost.set_cycles / 1000:.0f}",
        f"{cost.sample_cycles * rate / 1000:.0f}",
    ]
    return f"| {' | '.join(cells)} |\n"


def fits(configuration: Configuration, cost: Cost, name: str) -> bool:
    """Print whether a processor carries a configuration, and return it."""
    processor = PROCESSORS[name]
    rate = {**DEFAULTS, **configuration.options}["SAMPLE_RATE"]
    load = cost.sample_cycles * rate / processor.clock_rate
    set_time = SAMPLES_AHEAD + cost.set_cycles / processor.clock_rate
    gap = (cost.request_cycles + cost.sample_cycles) / processor.clock_rate  # between two samples
    sys.stdout.write(
        f"{name}: load {load:.0%}, a set starts after {1e3 * set_time:.2f} ms, "
        f"samples are at most {1e3 * gap:.2f} ms apart\n"
    )
    return load < MAX_LOAD and set_time < MAX_SET_TIME and gap < SAMPLES_AHEAD


def main() -> None:
    """Print the table; exit 1 if a processor does not carry its configuration."""
    sys.stdout.write(HEAD)
    costs = {}
    for configuration in CONFIGURATIONS:
        for name in configuration.cores:
            cost = cost_of(configuration, CORES[name])
            sys.stdout.write(row_of(configuration, name, cost))
            sys.stdout.flush()
            costs[id(configuration), name] = cost
    verdicts = []
    for configuration in CONFIGURATIONS:
        for name in configuration.processors:
            cost = costs[id(configuration), PROCESSORS[name].core]
            verdicts.append(fits(configuration, cost, name))
    sys.exit(not all(verdicts))


if __name__ == "__main__":
    main()

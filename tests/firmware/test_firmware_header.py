"""The headers of the firmware and the table of the protocol."""

import subprocess
import sys
from pathlib import Path

import pytest

from drivers.protocol.records import Number, Record, WireQuantity
from firmware_records import SENT, records_header
from installed_program import installed_program

ROOT = Path(__file__).parents[2]
GROWN = """
#include "records.h"
#include <stdio.h>
int main(void)
{
    uint16_t levels[] = {11, 12}, tokens[] = {13};
    struct wire_status status = {
        .uptime = 70000, .state = 1, .fault = 2, .flags = 3, .latch = 4, .watchdog_left = 5,
        .temperature = -100, .voltage = 7, .token = 8, .channels = 2, .layers = 1,
        .levels = levels, .tokens = tokens,
    };
    struct words words = {.count = 0};
    put_status(&words, &status);
    for (unsigned i = 0; i < words.count; i++)
        printf("%u ", words.words[i]);
    printf("%d", STATUS_WORDS(2, 1));
}
"""


@pytest.mark.parametrize(
    ("program", "header"),
    [("firmware_header.py", "protocol.h"), ("firmware_records.py", "records.h")],
)
def test_header_is_that_of_the_table(program: str, header: str) -> None:
    """`docs/generators/PROGRAM > firmware/core/HEADER` was run since the table changed."""
    generator = ROOT / "docs" / "generators" / program
    done = subprocess.run([sys.executable, generator], capture_output=True, text=True, check=True)
    assert (ROOT / "firmware" / "core" / header).read_text("utf-8") == done.stdout


def test_status_that_has_grown_is_sent_by_the_names_of_its_fields(tmp_path: Path) -> None:
    """A number behind levels and tokens goes there, high word first, and is counted."""
    compiler = installed_program("cc", package="gcc")
    uptime = Number("uptime", WireQuantity("uptime", "u32", 1, "s", 0, 0xFFFFFFFF))
    grown = Record(*SENT["status"].fields, uptime)
    (tmp_path / "records.h").write_text(records_header({"status": grown}))
    (tmp_path / "grown.c").write_text(GROWN)
    program = tmp_path / "grown"
    includes = [f"-I{tmp_path}", f"-I{ROOT / 'firmware' / 'core'}"]
    command = [compiler, "-std=c99", "-Wall", *includes, "-o", program, tmp_path / "grown.c"]
    subprocess.run(command, check=True)
    words = [int(word) for word in subprocess.check_output([program], text=True).split()]
    assert words == [1, 2, 3, 4, 5, 65436, 7, 8, 513, 11, 12, 13, 1, 4464, 14]

"""What the firmware sends, as the header of its records makes it."""

import subprocess
from pathlib import Path

from drivers.protocol.records import Bits, Number, Numbers, Record, Rows, WireQuantity
from firmware_records import records_header
from typed_page import installed_program

ROOT = Path(__file__).parents[2]
WORD = WireQuantity("word", "u16", 1, "", 0, 0xFFFF)
SIGNED = WireQuantity("signed", "i16", 1, "", -100, 100)
LONG = WireQuantity("long", "u32", 1, "", 0, 0xFFFFFFFF)
MADE_UP = Record(
    *(Number("first", SIGNED), Bits((("count", 8), ("is_so", 1), ("many", 2)))),
    *(Numbers("levels", "count", WORD), Rows("pairs", "many", Record(Number("a", LONG)))),
    Number("behind", LONG),
)
PROGRAM = """
#include "records.h"
#include <stdio.h>
int main(void)
{
    uint16_t levels[] = {11, 12};
    struct wire_pair pairs[] = {{.a = 13}, {.a = 0x20003}, {.a = 4}};
    struct wire_made_up made_up = {
        .behind = 70000, .pairs = pairs, .levels = levels, .many = 3, .count = 2, .first = -100,
    };
    struct words words = {.count = 0};
    put_made_up(&words, &made_up);
    for (unsigned i = 0; i < words.count; i++)
        printf("%u ", words.words[i]);
    printf("%d", MADE_UP_WORDS(2, 3));
}
"""


def test_record_is_sent_by_the_names_of_its_fields(tmp_path: Path) -> None:
    """In the order of the record, also behind what varies; of two words the high one goes first."""
    compiler = installed_program("cc", package="gcc")
    (tmp_path / "records.h").write_text(records_header({"made_up": MADE_UP}))
    (tmp_path / "sent.c").write_text(PROGRAM)
    options = ("-std=c99", "-Wall", f"-I{tmp_path}", f"-I{ROOT / 'firmware' / 'core'}")
    subprocess.run([compiler, *options, "sent.c"], cwd=tmp_path, check=True)
    *words, count = map(int, subprocess.check_output([tmp_path / "a.out"], text=True).split())
    assert words == [65436, 2 << 3 | 3, 11, 12, 0, 13, 2, 3, 0, 4, 1, 4464]
    assert count == len(words)

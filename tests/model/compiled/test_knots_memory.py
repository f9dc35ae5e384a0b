"""The kernel of knots in its memory, under sanitizers."""

import subprocess
from pathlib import Path

import pytest

import model.compiled
from long_form import shortly
from model.compiled.kernels import Version, processor_features, versions

HERE = Path(__file__).parent
RUNNABLE = [each for each in versions() if each.features.keys() <= processor_features()]
SANITIZERS = ("-O1", "-g", "-fsanitize=address,undefined", "-fno-sanitize-recover=all")


@pytest.mark.parametrize("version", shortly(RUNNABLE, RUNNABLE[:1]), ids=lambda each: each.name)
def test_knots_are_within_the_stroke_and_their_memory(version: Version, tmp_path: Path) -> None:
    """Of 28 random tones, huge, silent and undefined ones too, and without memory for one.

    Some reach the bound of full stroke, and none is beyond it.
    """
    program = tmp_path / "harness"
    folder = Path(*model.compiled.__path__)
    files = (f"-I{folder}", "-o", str(program), str(HERE / "knots_harness.c"), "-lm")
    subprocess.run(["cc", *version.flags, *SANITIZERS, *files], check=True)
    done = subprocess.run([program], check=True, capture_output=True, text=True)
    assert done.stdout.strip() == "1.000"
    assert not done.stderr

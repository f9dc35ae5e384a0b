"""The demonstration to be touched, with a small table: python live_demonstration.py."""

import asyncio
import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[1] / "support"))
from controller.demo.demonstration import run_live
from kit.plates import small_table
from model.rig.rig_file import example_rig_path

if __name__ == "__main__":
    asyncio.run(run_live(example_rig_path(), small_table(), wire="serial", dashboard="127.0.0.1:0"))

"""What a touch source delivers, as contacts on the paper's plate, until the last finger lifts.

python try_source.py URL
"""

import asyncio
import sys

import era_haptics as era
from era_haptics.plugins.touch_sources import (
    Change,
    ContactTracker,
    TouchFrame,
    now,
    open_source,
)

LOOK = 0.015  # s; whoever is silent for 150 ms is found soon after


async def main(url: str) -> None:
    """Follow its contacts; a finger that is not heard of in time is lifted, as in the daemon."""
    tracker = ContactTracker(era.load_rig(era.example_rig_path()).plate)
    source = open_source(url)
    ended = asyncio.Event()
    told = {"frames": 0, "moves": 0}

    def show(change: Change) -> None:
        told["moves"] += len(change.moved)
        for word, contacts in (("down", change.down), ("up  ", change.up)):
            for contact in contacts:
                print(f"{word} at {100 * contact.x:.1f}, {100 * contact.y:.1f} cm")
        for reason in change.rejected:
            print(f"rejected: {reason}")
        if change.up and not tracker.contacts:
            ended.set()

    def deliver(frame: TouchFrame) -> None:
        told["frames"] += 1
        show(tracker.update(frame))

    async def expire() -> None:
        while True:
            await asyncio.sleep(LOOK)
            show(tracker.expire(now()))

    tasks = [asyncio.create_task(work) for work in (source.run(deliver), expire(), ended.wait())]
    await asyncio.sleep(0.1)  # for it to open, or to say why it cannot
    print(f"listening to {url}", flush=True)
    done, _ = await asyncio.wait(tasks, return_when=asyncio.FIRST_COMPLETED)
    for task in tasks:
        task.cancel()
    await asyncio.gather(*tasks, return_exceptions=True)
    for task in done:
        task.result()
    print(f"{told['frames']} frames, {told['moves']} moves")


if len(sys.argv) != 2:
    sys.exit(__doc__)
try:
    asyncio.run(main(sys.argv[1]))
except era.InputError as error:
    sys.exit(f"error: {error}")

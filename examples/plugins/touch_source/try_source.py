"""Print the contacts of a touch source on the paper's plate until the last finger lifts.

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

EXPIRY_INTERVAL = 0.015  # s


async def main(url: str) -> None:
    """Track contacts; like the daemon, lift fingers whose reports stop."""
    tracker = ContactTracker(era.load_rig(era.example_rig_path()).plate)
    source = open_source(url)
    ended = asyncio.Event()
    counts = {"frames": 0, "moves": 0}

    def show(change: Change) -> None:
        counts["moves"] += len(change.moved)
        for event, contacts in (("down", change.down), ("up  ", change.up)):
            for contact in contacts:
                print(f"{event} at {100 * contact.x:.1f}, {100 * contact.y:.1f} cm")
        for reason in change.rejected:
            print(f"rejected: {reason}")
        if change.up and not tracker.contacts:
            ended.set()

    def deliver(frame: TouchFrame) -> None:
        counts["frames"] += 1
        show(tracker.update(frame))

    async def expire() -> None:
        while True:
            await asyncio.sleep(EXPIRY_INTERVAL)
            show(tracker.expire(now()))

    jobs = (source.run(deliver), expire(), ended.wait())
    tasks = [asyncio.create_task(job) for job in jobs]
    await asyncio.sleep(0.1)  # the source opens or fails
    print(f"listening to {url}", flush=True)
    done, _ = await asyncio.wait(tasks, return_when=asyncio.FIRST_COMPLETED)
    for task in tasks:
        task.cancel()
    await asyncio.gather(*tasks, return_exceptions=True)
    for task in done:
        task.result()
    print(f"{counts['frames']} frames, {counts['moves']} moves")


if len(sys.argv) != 2:
    sys.exit(__doc__)
try:
    asyncio.run(main(sys.argv[1]))
except era.InputError as error:
    sys.exit(f"error: {error}")

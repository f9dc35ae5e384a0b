"""Hold two fingers on the plate for a while, and print the plate's events.

    python follow.py 0.40,0.23 0.13,0.23      # metres from the south-west corner

The last finger is the target. The daemon must be ready (`era status`). A lost connection is made
again, subscriptions included; `armed` renews its lease over it, and raises LeaseLost if that is
too late.
"""

import asyncio
import sys

import era_haptics as era

HELD = 1.0  # s
REPEATED = 0.05  # s; a finger that is not repeated for 150 ms is lifted


async def hold(client: era.AsyncClient, places: list[tuple[float, float]]) -> None:
    """Hold fingers at places for a while."""
    for _ in range(round(HELD / REPEATED)):
        await client.touch(places)
        await asyncio.sleep(REPEATED)
    await client.touch([])


async def follow(client: era.AsyncClient) -> None:
    """Print events until cancelled."""
    await client.subscribe("state", "pattern", "silence")
    async for event in client.events():
        if event.topic == "state":
            print(f"{event.data['word']}: {event.data['cause']}")
        elif event.topic == "pattern":
            print("played by", ", ".join(sorted(event.data["drive"])))
        else:
            print("silent:", event.data["reason"])


async def main(*arguments: str) -> None:
    """Arm, hold the fingers and disarm."""
    places = [(float(x), float(y)) for x, y in (each.split(",") for each in arguments)]
    async with await era.AsyncClient.connect(name="follow") as client:
        following = asyncio.create_task(follow(client))
        async with client.armed("follow"):
            await hold(client, places)
        following.cancel()


if __name__ == "__main__":
    try:
        asyncio.run(main(*sys.argv[1:]))
    except (era.RpcError, era.Unreachable) as error:
        sys.exit(str(error))

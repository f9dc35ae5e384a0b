"""Hold two fingers on the plate for a while, and print the plate's events.

    python follow.py 0.40,0.23 0.13,0.23      # meters from the south-west corner

Each finger gets the effect that the layout has at its position. The daemon must be ready
(`era status`). The client reconnects and resubscribes automatically. `armed` then renews its lease,
and raises LeaseLost if the lease has expired.
"""

import asyncio
import sys

import era_haptics as era

HOLD_TIME = 1.0  # s
REPEAT_INTERVAL = 0.05  # s; a finger expires 150 ms after its last report


async def hold(client: era.AsyncClient, positions: list[tuple[float, float]]) -> None:
    """Hold fingers at some positions [m] for HOLD_TIME."""
    for _ in range(round(HOLD_TIME / REPEAT_INTERVAL)):
        await client.touch(positions)
        await asyncio.sleep(REPEAT_INTERVAL)
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
    positions = []
    for argument in arguments:
        x, y = argument.split(",")
        positions.append((float(x), float(y)))
    async with await era.AsyncClient.connect(name="follow") as client:
        following = asyncio.create_task(follow(client))
        async with client.armed("follow"):
            await hold(client, positions)
        following.cancel()


if __name__ == "__main__":
    try:
        asyncio.run(main(*sys.argv[1:]))
    except (era.RpcError, era.Unreachable) as error:
        sys.exit(str(error))

"""Checks of layers: each plays on until it is named, ends by itself, is renewed, or follows."""

from drivers.conformance.check import driving
from drivers.conformance.expected import ENABLED, NAMES
from drivers.conformance.findings import expect_equal
from drivers.conformance.material import layer
from drivers.conformance.subject import Subject

_PLACE = "protocol.md#sets"


@driving(_PLACE)
async def layers_add(subject: Subject) -> None:
    """It plays the sum of its layers, each with its own token, and those not named play on."""
    await subject.arm()
    share, last = 1 / len(subject.layers), len(subject.layers) - 1
    tones = [subject.tone(0, share, frequency=subject.apart(each)) for each in subject.layers]
    filled = [[layer(number, tones[number])] for number in reversed(subject.layers)]
    emptied = [[layer(number)] for number in subject.layers[:-1]]
    for sets in (*filled, *emptied, [layer(0, tones[0]), layer(last)]):
        await subject.play(*sets)
        await subject.status()


@driving(_PLACE)
async def layers_play_on(subject: Subject) -> None:
    """It lets ramps, onsets and ends of layers that a set does not name go on as they were."""
    ramp = subject.ramp
    first = layer(0, subject.tone(0, 0.75), ramp=ramp, valid_for=ramp + 100)
    others = [layer(1, subject.tone(0, each, frequency=subject.other)) for each in (0.25, 0.125)]
    await subject.course(first, 0.02, *others, others[0])


@driving(_PLACE)
async def valid_for(subject: Subject) -> None:
    """It ends a layer after its valid_for, along its ramp, and stays armed; 0 and 60 s last."""
    ramp = min(100, subject.can["ramp_max"])
    for time, fade in ((1, 0), (100, 0), (150, ramp)):
        await subject.course(subject.one(ramp=fade, valid_for=time))
        state = (await subject.status())["state"]
        expect_equal(NAMES[state], ENABLED, f"state after a valid_for of {time} ms")
    half, quarter = subject.tone(0, 0.5), subject.tone(0, 0.25, frequency=subject.apart(1))
    third = subject.tone(0, 0.25, frequency=subject.apart(2))
    await subject.rest()
    await subject.arm()
    await subject.play(
        layer(0, half, valid_for=100), layer(1, quarter, valid_for=60_000), layer(2, third)
    )
    await subject.follow(0.3)
    await subject.play(layer(0, half, valid_for=60))
    await subject.play(layer(0, half))
    await subject.follow(0.1)


@driving(_PLACE)
async def renew(subject: Subject) -> None:
    """It starts valid_for anew by a renewal, and changes nothing else."""
    second = layer(1, subject.tone(0, 0.25, frequency=subject.apart(1)))
    third = layer(3, subject.tone(0, 0.25, frequency=subject.apart(3)), valid_for=60)
    first = layer(0, subject.tone(0, 0.5), ramp=40, valid_for=200)
    await subject.course(first, second, 0.1, layer(0, renew=True, valid_for=250))
    await subject.course(layer(2, renew=True, valid_for=100), second)
    await subject.course(third, layer(3, renew=True), 0.12)


@driving(_PLACE)
async def after(subject: Subject) -> None:
    """It starts commands with *after* once the onsets of the layer have ended, at once without."""
    onset = subject.envelope(0.05, 0.5, 1, 0.5)
    first = subject.one(subject.tone(onset=onset))
    waiting = layer(0, subject.tone(0, 0.25, frequency=subject.other), after=True)
    newer = layer(0, subject.tone(0, 0.75), after=True)
    await subject.course(first, newer, waiting)  # which replaces the newer
    await subject.course(subject.one(), waiting)
    await subject.course(first, waiting, layer(0), 0.25)
    await subject.course(first, waiting, layer(0, subject.tone(0, 0.75)), 0.25)
    await subject.rest()
    await subject.arm()
    await subject.play(first)
    await subject.play(waiting)
    plays = (await subject.request("GetAchieved", layer=0))["commands"]
    expect_equal(plays[0]["frequency"], subject.frequency, "frequency that is achieved")
    await subject.request("Silence", session=subject.session, ramp=0)
    await subject.follow(0.25)

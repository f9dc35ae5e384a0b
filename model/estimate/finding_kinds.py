"""Kinds of findings of a rig check, with their texts.

A kind is an entry of `FINDING_KINDS`, which is also the source of a table in
`docs/how-to/measure-your-plate.md`.
"""

from dataclasses import dataclass


@dataclass(frozen=True)
class FindingKind:
    """A kind of finding."""

    text: str
    """Printed line with placeholders for fields and details of a finding: problem and remedy."""
    criterion: str
    """Criterion of the finding, as printed on the page."""
    about: str = "channel"
    """Subject: `file` (the rig file describes it the wrong way round), `channel`, `sensor` (left
    out), `plate`, `load` (object on the plate) or `form` (difference that no rig key describes)."""
    is_fault: bool = True
    """Whether it fails the check."""


FINDING_KINDS = {
    "mirrored": FindingKind(
        "PLACES: sensor positions must be measured from the same corner as ERA positions, "
        "got positions mirrored in {of}: {coarse}; correct all sensor positions{or_plugs}",
        "in a coarse fit, mirrored sensor positions reduce the unexplained share to less than 0.6 "
        "of its value; the check continues with the mirrored positions",
        "file",
    ),
    "reversed": FindingKind(
        "PLACES: frequencies must be in the order of their responses, got reversed order: {coarse}",
        "as for `mirrored`, with the frequencies in reverse order",
        "file",
    ),
    "exchanged": FindingKind(
        "PLACES: sensors must be at their stated positions, got exchanged positions: "
        "{of}; correct the positions or names",
        "responses fit the position of another sensor (coherence above 0.9; below 0.8 at their "
        "own position); the check continues with the positions corrected",
        "file",
    ),
    "grain": FindingKind(
        "GRAIN: plate.grain must be {along}, got {as_written}: a coarse fit leaves {percent} of "
        "the responses unexplained with the grain along the {along}, {percent_as_written} with "
        "the grain along the {as_written}; look at the veneer of its faces, and correct the rig",
        "in a coarse fit, the grain along the other side reduces the unexplained share to less "
        "than 0.6 of its value; the check continues with that grain",
        "file",
    ),
    "resonance": FindingKind(
        "RESONANCE: resonance_is of {of} must be {which}, got {as_written}: if {which}, "
        "a glued magnet resonates at {value:.0f} Hz and gains vary by a factor of "
        "{factor:.2g} over frequency; if {as_written}, by {factor_as_written:.2g}; correct the rig",
        "gains of exciters vary too much over frequency (standard deviation of their logarithm "
        "above 0.8), but less than half as much with the other `resonance_is`; the check "
        "continues with the other",
        "file",
    ),
    "swapped": FindingKind(
        "SWAPPED: {channel_1} drives ERA {era_2}, and {channel_2} drives ERA {era_1} (confidence "
        "{confidence:.3f}): exchange the two plugs, or the channels in the rig",
        "two channels drive each other's ERA (criterion: `other ERA`)",
    ),
    "cycle": FindingKind(
        "SWAPPED in a cycle: the channels of {of} each drive the next one's ERA (confidence "
        "{confidence:.3f}): correct the plugs",
        "three or more channels drive each other's ERAs in a cycle",
    ),
    "all strong or weak": FindingKind(
        "{state}: the channels of {of} play {least:.2f} to {value:.2f} of the "
        "commanded amplitude: check the sensors' sensitivity first, which affects all channels "
        "alike; then the amplifier's volume",
        "three quarters of the channels are strong, or three quarters are weak",
    ),
    "all inverted": FindingKind(
        "INVERTED: all channels have the opposite sign of the sensors: turn "
        "the sensors over, swap the two wires of every ERA, or check the sign convention of phases",
        "all channels are inverted",
    ),
    "dead": FindingKind(
        "DEAD: {wiring} does not move the plate: check its supply, its cable and the "
        "amplifier's channel",
        "the response is below 3 % of the prediction, or faint and unlike the prediction for any "
        "ERA",
    ),
    "loose": FindingKind(
        "LOOSE: {wiring} acts on the plate with only part of its contact, such as an exciter "
        "whose glue has come off: press it on or glue it again, and measure again",
        "the plate does not match, and the parameter farthest off is the stiffness or weight of "
        "an exciter, below 0.7 of its value; or a channel's gain rises with frequency relative to "
        "the other channels",
    ),
    "weak": FindingKind(
        "WEAK: {wiring} plays {value:.2f} of the commanded amplitude: check its voltage, "
        "volume and mounting, or measure its gain with `era calibrate`",
        "the gain is below 0.8 of the rig's; in a rig with large `uncertainty`, 3.5 standard "
        "deviations of `gain` (for exciters also `stiffness`) below the rig's",
    ),
    "strong": FindingKind(
        "STRONG: {wiring} plays {value:.2f} of the commanded amplitude: lower its voltage or "
        "volume, or correct its stroke or gains in the rig",
        "as for `weak`, but above 1.25 of the rig's",
    ),
    "other ERA": FindingKind(
        "WRONG ERA: {wiring} drives ERA {drives} instead of {of} (MAC {mac_found:.3f}, with its "
        "own ERA {mac_own:.3f}; confidence {confidence:.3f}): correct the plug, or the rig's "
        "channels",
        "the response shape over the sensors fits another ERA (MAC over the frequencies; "
        "confidence from a t-test), and this explains the whole plate better",
    ),
    "inverted": FindingKind(
        "INVERTED: {wiring} has the opposite sign of the others: swap its two wires",
        "the phase relative to the drive is off by 90° or more",
    ),
    "out of phase": FindingKind(
        "OUT OF PHASE: {wiring} is off by {phase:+.0f}°: measure its gains with `era calibrate`",
        "the phase is off by more than 45°",
    ),
    "silent": FindingKind(
        "SENSOR {of} has no signal: left out",
        "no signal from any channel; the sensor is left out",
        "sensor",
        is_fault=False,
    ),
    "mute": FindingKind(
        "SENSOR {of} reads {value:.2f} times the value implied by the other sensors: check its "
        "position and its cable: left out",
        "at most a tenth of the value implied by the other sensors; left out",
        "sensor",
        is_fault=False,
    ),
    "upside down": FindingKind(
        "SENSOR {of} is upside down (reads {value:.2f} times the value implied by the other "
        "sensors): turn it over: left out",
        "opposite sign, and at least half of the value implied by the other sensors; left out",
        "sensor",
        is_fault=False,
    ),
    "off scale": FindingKind(
        "SENSOR {of} reads {value:.2f} times the value implied by the other sensors: left out",
        "less than 0.7 or more than 1.4 times the value implied by the other sensors; left out",
        "sensor",
        is_fault=False,
    ),
    "plate": FindingKind(
        "PLATE: the rig does not match the plate: {why}\n{hypotheses}",
        "no plate within the rig's tolerances explains the measurement",
        "plate",
    ),
    "detached": FindingKind(
        "DETACHED: ERA {of} holds the plate with {value:.2f} of its stiffness: tighten its bolt, "
        "or look for a spring that came off",
        "the plate is best explained by an ERA with less than a tenth of its stiffness",
        "plate",
    ),
    "outliers": FindingKind(
        "OUTLIERS: {count} left out, including {value} at sensor {of}: check for loose "
        "contacts if they are many",
        "values that a calibration would leave out, up to 5 % of all",
        "plate",
        is_fault=False,
    ),
    "mass": FindingKind(
        "MASS: {grams} at ({x_m:.2f}, {y_m:.2f}) m: remove it, or write it to the rig's masses",
        "one or two additional masses, together at least 2 % of the plate's mass",
        "load",
    ),
    "finger": FindingKind(
        "FINGER: the plate is touched at ({x_m:.2f}, {y_m:.2f}) m: remove the object "
        "there, and measure again",
        "a soft, damped load, such as a fingertip",
        "load",
    ),
    "thickness": FindingKind(
        "THICKNESS: according to its sensors, the plate is {along_x} thicker at the end of x and "
        "{along_y} at the end of y than in its middle: check it, or the sensors' scales",
        "the plate is thicker at one end, or the sensors' scales rise toward it",
        "form",
    ),
    "unnamed": FindingKind(
        "UNNAMED: values match the rig, but something else differs: {difference}; "
        "check the plate's thickness, parts bonded to it and the sensors' scales, and measure for "
        "`era calibrate`",
        "form errors (which no rig key describes) are larger than on 99 % of plates, for example "
        "due to a bonded frame; or more than 5 % is unexplained",
        "form",
    ),
    "promise": FindingKind(
        "PROMISE: half of the answers of the rig's table miss their promised contrast "
        "by {value:.1f} dB or more",
        "half of the answers of the rig's table miss their promise by 1 dB or more",
        "plate",
    ),
}
"""All kinds of findings by name."""

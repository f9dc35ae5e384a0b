"""What a measurement has not shown, and the tone and the sensor that would show it."""

from dataclasses import dataclass, replace

import numpy as np

from model.arrays import ComplexArray, FloatArray, best_of
from model.identification.derivatives import jacobian
from model.identification.forward import Sensor
from model.identification.posterior import Posterior, relevant
from model.identification.stages import FittedModel, Setting

UNKNOWN = 0.5
"""Share of its standard deviation before, beyond which a measurement has not shown something.

Of that of a plate that was not measured, where the rig states less: answers need no more.
"""

SUSPENSION_FELT = 120.0
"""Hz; above it fields change by less than 5 % with a suspension that is 20 % off."""

_STEP = 20.0  # Hz between the tones that are considered
_NOISE = 0.01
_SHARES = (0.13, 0.5, 0.87)  # of the sides, where further sensors are considered


@dataclass(frozen=True)
class UnknownQuantity:
    """Something that was not identified: its name and standard deviations before and after.

    Advised: an ERA and a frequency [Hz] to play, and a sensor at an ERA or at x, y [m].
    """

    name: str
    before: float
    after: float
    era: str
    frequency: float
    sensor: Sensor

    def __str__(self) -> str:
        sensor = self.sensor
        place = f"ERA {sensor.era}" if sensor.era else f"({sensor.x:.3g}, {sensor.y:.3g}) m"
        return (
            f"{self.name}: known to {100 * self.after:.2g} %, before {100 * self.before:.2g} %; "
            f"play ERA {self.era} at {self.frequency:.0f} Hz and measure at {place}"
        )


def unknowns(setting: Setting, fitted: FittedModel, posterior: Posterior) -> list[UnknownQuantity]:
    """All that answers depend on and the measurement has not shown, with what would show it."""
    space, found = posterior.space, []
    prior = replace(posterior, covariance=np.diag(space.uncertain.astype(float)))
    built = replace(prior, space=space.as_built)
    for kind, rows in relevant(space).items():
        before, after = prior.std_of(rows), posterior.std_of(rows)
        unknown = np.flatnonzero((before > 0) & (after > UNKNOWN * built.std_of(rows)))
        if kind == "stiffness" and setting.measurement.frequencies[0] > SUSPENSION_FELT:
            excites = ["force_factor" in era.fields for era in setting.rig.eras]
            unknown = unknown[~np.array(excites)[unknown]]
        # Of losses and frequencies of single modes only those count that no tone has shown.
        if not len(unknown) or (kind in ("frequency", "loss") and len(unknown) < len(rows)):
            continue
        worst = unknown[best_of(after[unknown])]
        name = kind if kind in ("frequency", "loss") else _name(rows[worst], space.names)
        best = _best(setting, fitted, posterior, rows[worst])
        found.append(UnknownQuantity(name, float(before[worst]), float(after[worst]), *best))
    return found


def _name(row: FloatArray, names: tuple[str, ...]) -> str:
    return names[best_of(np.abs(row))]


def _best(
    setting: Setting, fitted: FittedModel, posterior: Posterior, row: FloatArray
) -> tuple[str, float, Sensor]:
    """ERA, frequency and sensor whose response would tell most of a combination (p,)."""
    rig, model = setting.rig, fitted.problem.model
    plate, limits = rig.plate, rig.limits
    measured = {sensor.era for sensor in model.sensors}
    more = [Sensor(f"ERA {era.name}", era.name) for era in rig.eras if era.name not in measured]
    more += [
        Sensor(f"{x:g} {y:g}", x=x * plate.length, y=y * plate.width)
        for x in _SHARES
        for y in _SHARES
    ]
    sensors = [*model.sensors, *more]
    tones = np.arange(limits.frequency_min, limits.frequency_max + 1e-9, _STEP)
    wider = replace(setting.model(model.mass_count, more=more), frequencies=tones, free=model.free)
    space = wider.space
    own = [space.index(name) for name in posterior.space.names]
    known, combination, unknown = posterior.within(space), np.zeros(space.size), space.std > 0
    combination[own], unknown[own] = row, False
    covariance = known.covariance + np.diag(unknown.astype(float))
    at = wider.at(known.x)
    scale = _NOISE * np.sqrt((np.abs(at.responses) ** 2).mean(axis=(0, 2), keepdims=True))
    direction = covariance @ (combination * space.std)
    gains = _gains(jacobian(at) / scale[..., None], covariance, direction)
    f, s, e = np.unravel_index(best_of(gains.ravel()), gains.shape)
    return rig.eras[e].name, float(tones[f]), sensors[s]


def _gains(J: ComplexArray, covariance: FloatArray, direction: FloatArray) -> FloatArray:
    """Decrease of a combination's variance by each response measured on its own, (f, s, e)."""
    total = np.zeros(J.shape[:3])
    for part in (J.real, J.imag):
        variance = ((part @ covariance) * part).sum(axis=-1)
        total += (part @ direction) ** 2 / (1 + variance)
    return total

"""How often 95 % intervals of parameters and regions of fields hold the truth."""

from dataclasses import replace

import numpy as np

from benchmarks.identification.hidden import Hidden
from benchmarks.identification.thin_plate import Mounted, Reals
from model.estimate.forward import Sensor, jacobian
from model.estimate.identify import Identification, model_of, relevant
from model.estimate.space import KINDS

_WITHIN = 1.96
_REGION = 5.991  # of two normal numbers
_PLACES = np.array([(0.25, 0.2), (0.5, 0.5), (0.8, 0.4), (0.35, 0.75)])


def parameters_held(found: Identification, own: Mounted) -> dict[str, Reals]:
    """Errors in standard deviations by kind: springs and dampers over mass, gains, frequencies."""
    space, x, plate = found.fitted.space, found.fitted.x, found.before.plate
    mass = np.log(own.plate.thickness / plate.thickness)
    model = found.fitted.model
    elastic = np.sort(own.plate.modes[0])[3 : 3 + len(model.shifted_modes)]
    solved = model.free
    theory = solved.modes.eigenvalues[model.shifted_modes]
    # Of the plate as written: that solved is of the thickness found.
    theory = theory * (plate.thickness / solved.plate.thickness) ** 2
    theory = theory * plate.material.E / solved.plate.material.E
    gain = np.log(np.abs(own.gain))
    phase = np.angle(own.gain)
    true = {
        "frequency": np.log(elastic / theory) / 2,
        "stiffness": np.log(own.stiffness / [era.stiffness for era in found.before.eras]) - mass,
        "damping": np.log(own.damping / [era.damping for era in found.before.eras]) - mass,
        "gain": gain - gain.mean(),
        "phase": phase - phase.mean(),
    }
    errors, stds = {}, found.stds()
    for kind, value in true.items():
        estimate = relevant(space)[kind] @ (space.std * x)
        errors[kind] = (estimate - value) / stds[kind]
    places = space.groups["place"]
    written = np.array([(era.x, era.y) for era in found.before.eras])
    errors["place"] = (space.std[places] * x[places] - (own.at - written).ravel()) / stds["place"]
    if len(own.masses) and len(found.values["masses"]):
        x, y, weight = own.masses[0]
        at = space.groups["masses"].start
        off = found.values["masses"][0] - [weight, x, y]
        std = np.hypot(found.std[at : at + 3], [0.0, *[KINDS["place"].theory] * 2])
        errors["mass"] = off / std
    return errors


def fields_held(found: Identification, hidden: Hidden, frequencies: Reals) -> Reals:
    """Squared distances of true fields from those identified, in their covariance, (values,)."""
    plate, model = found.before.plate, found.fitted.model
    points = _PLACES * [plate.length, plate.width]
    pads = [Sensor(f"point {n}", x=x, y=y) for n, (x, y) in enumerate(points.tolist())]
    masses, tones = model.mass_count, frequencies[1::4]
    wider = model_of(found.before, model.free, found.fitted.measurement, masses=masses, more=pads)
    wider = replace(wider, frequencies=tones)
    x, covariance = found.within(wider.space)
    at = wider.at(x)
    J = jacobian(at)[:, len(model.sensors) :]
    own_fields = at.responses[:, len(model.sensors) :]
    nothing = np.zeros((0, 4))
    true = np.array([hidden.felt(float(f), points, points, nothing) for f in tones])
    error = own_fields - true
    parts = np.stack([J.real, J.imag], axis=-2)
    spread = parts @ covariance @ parts.swapaxes(-1, -2)
    both = np.stack([error.real, error.imag], axis=-1)
    solved = np.linalg.solve(spread, both[..., None])[..., 0]
    return np.asarray((both * solved).sum(axis=-1)).ravel()


def share_within(errors: Reals) -> float:
    """Share of errors in standard deviations that are within the 95 % interval."""
    return float((np.abs(errors) < _WITHIN).mean())


def share_in_region(distances: Reals) -> float:
    """Share of squared distances that are in the 95 % region."""
    return float((distances < _REGION).mean())

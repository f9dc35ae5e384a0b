"""Least-squares fits of the lead of one clock over another.

The lead is a function of time t with an offset [s], a rate [s/s] and a bend [1/s]:

    lead(t) = offset + rate (t - time) + bend (t - time)^2

`fit_lower_half` fits it to readings of a clock. A request can be delayed but never arrives early,
so a reading shows the true lead plus a delay, and the fit uses the lower half of the readings.
`fit_difference` fits a line to the differences of two clocks at common Marks.
"""

import math
from collections.abc import Iterable, Sequence
from typing import NamedTuple

RECENT = 8
"""Number of recent readings. If all recent readings are above the fit, the fit may be too low by
the smallest distance; if they are far above it, the clock was moved."""
MIN_ERROR = 5e-7
"""Minimum error [s] of a reading, and of the time that this process reads."""
_ITERATIONS = 3
"""Iterations of fitting the lead and selecting the readings that are fitted."""
_ERROR_FACTOR = 1.4
"""Factor of a standard error, from a simulation: the lowest of several readings are correlated."""
_EXPECTED_RATE = 50e-6
"""Expected rate of a crystal relative to the host's; a larger rate needs a good measurement."""
_EXPECTED_BEND = 2e-7
"""Half of the expected change of a crystal's rate [1/s] while it warms up."""


class Reading(NamedTuple):
    """A reading of a clock, without the lead that steering has added."""

    time: float
    """When the request arrives at the earliest [s]."""
    lead: float
    """Lead at that time [s]: the true lead plus the delay of the request."""
    max_delay: float
    """Largest possible delay [s], or 0 if it is subtracted already."""


class LeadFit(NamedTuple):
    """A fitted lead, see the equation of this module."""

    time: float
    """The moment to which the coefficients refer [s]."""
    offset: float = 0.0
    """Lead at that moment [s]."""
    rate: float = 0.0
    """Change of the lead at that moment [s/s]."""
    bend: float = 0.0
    """Half of the change of the rate [1/s]."""
    error: float = math.inf
    """Standard error of the offset [s]."""
    rate_error: float = _EXPECTED_RATE
    """Standard error of the rate."""

    def on_line(self, time: float) -> float:
        """Return the lead at a time [s] on the tangent, without the bend."""
        return self.offset + self.rate * (time - self.time)

    def error_at(self, time: float) -> float:
        """Return the standard error of the lead [s] on the tangent at a time [s]."""
        elapsed = time - self.time
        if elapsed <= 0.0:
            return self.error
        return self.error + self.rate_error * elapsed

    def at(self, time: float) -> "LeadFit":
        """Return the tangent with its coefficients at another time [s]."""
        offset = self.on_line(time)
        return LeadFit(time, offset, self.rate, 0.0, self.error_at(time), self.rate_error)

    def plus(self, difference: "LeadFit") -> "LeadFit":
        """Return the lead of a clock that differs from this one; both are for the same time."""
        return LeadFit(
            self.time,
            self.offset + difference.offset,
            self.rate + difference.rate,
            0.0,
            self.error + difference.error,
            self.rate_error + difference.rate_error,
        )


class _Moments(NamedTuple):
    """Sums over leads y at times x relative to the mean time; z = x^2 - mean(x^2)."""

    mean_lead: float
    mean_age: float
    xx: float
    xy: float
    yy: float
    """The sum of (y - mean(y))^2."""
    zy: float
    zz: float


def _moments(aged_leads: Sequence[tuple[float, float]]) -> _Moments:
    """Return the moments of leads [s], which are given with their ages [s].

    Since sum(y - mean(y)) = 0, sum(z y) = sum(x^2 (y - mean(y))); and sum(z^2) is the sum of x^4
    minus sum(x^2) mean(x^2).
    """
    count = len(aged_leads)
    lead_sum = age_sum = 0.0
    for lead, age in aged_leads:
        lead_sum += lead
        age_sum += age
    mean_lead = lead_sum / count
    mean_age = age_sum / count
    xx = xy = yy = xxy = xxxx = 0.0
    for lead, age in aged_leads:
        x = mean_age - age
        y = lead - mean_lead
        square = x * x
        xx += square
        xy += x * y
        yy += y * y
        xxy += square * y
        xxxx += square * square
    zz = xxxx - xx * xx / count
    return _Moments(mean_lead, mean_age, xx, xy, yy, xxy, zz)


def aged_leads_of(readings: Iterable[Reading], time: float) -> list[tuple[float, float]]:
    """Return the leads of readings and their ages at a time [s]."""
    return [(lead, time - read_at) for read_at, lead, _ in readings]


def current_leads(
    aged_leads: Sequence[tuple[float, float]], rate: float, bend: float
) -> list[tuple[float, float]]:
    """Return the leads that readings predict for age 0, where rate and bend apply, and the ages."""
    return [(lead + (rate - bend * age) * age, age) for lead, age in aged_leads]


class _Regression(NamedTuple):
    """A quadratic regression through leads, see `_regress`."""

    moments: _Moments
    rate_change: float
    bend_change: float
    rate_weight: float
    bend_weight: float


def _regress(
    leads: Sequence[tuple[float, float]], rate: float, bend: float, min_variance: float
) -> _Regression:
    """Return the regression through leads that a rate and a bend have brought to one time.

        y = mean(y) + rate_change x + bend_change z + residual
        rate_change = (sum(x y) - prior) / rate_weight, rate_weight = sum(x^2) + prior weight
        bend_change = (sum(z y) - prior) / bend_weight, bend_weight = sum(z^2) + prior weight

    x is the time relative to the mean time of the leads, and z = x^2 - mean(x^2). The three
    regressors 1, x and z are taken as orthogonal, as they are for evenly spaced readings. The
    priors state that the rate in the middle of the readings and the bend are zero, within the
    errors expected for crystals; the weight of a prior is the variance of the residuals divided by
    the square of the expected error. min_variance: lower limit of the variance [s^2].
    """
    moments = _moments(leads)
    residual_sum = moments.yy - moments.xy**2 / (moments.xx or 1.0)
    variance = max(residual_sum, 0.0) / len(leads) + min_variance
    rate_weight = moments.xx + variance / _EXPECTED_RATE**2
    bend_weight = moments.zz + variance / _EXPECTED_BEND**2
    rate_prior = (rate - 2 * bend * moments.mean_age) * variance / _EXPECTED_RATE**2
    bend_prior = bend * variance / _EXPECTED_BEND**2
    rate_change = (moments.xy - rate_prior) / rate_weight
    bend_change = (moments.zy - bend_prior) / bend_weight
    return _Regression(moments, rate_change, bend_change, rate_weight, bend_weight)


class LowestFit(NamedTuple):
    """A fit to the lower half of readings."""

    fit: LeadFit
    lowest_lead: float
    """The lowest of the readings [s], brought to the time of the fit."""


def fit_lower_half(
    readings: Sequence[Reading], last_fit: LeadFit, time: float, min_variance: float
) -> LowestFit:
    """Fit a lead at a time [s] to the lower half of readings by weighted least squares.

    Each iteration brings the leads of the readings to that time with the previous rate and bend. A
    regression through the lower half of these leads then corrects rate and bend. min_variance:
    lower limit of the variance of the readings [s^2].
    """
    count = max(len(readings) // 2, 1)
    rate = last_fit.rate
    bend = last_fit.bend
    aged_leads = aged_leads_of(readings, time)
    for _ in range(_ITERATIONS):
        leads = sorted(current_leads(aged_leads, rate, bend))
        regression = _regress(leads[:count], rate, bend, min_variance)
        mean_age = regression.moments.mean_age
        rate = rate + regression.rate_change + 2 * regression.bend_change * mean_age
        bend = bend + regression.bend_change
    moments, rate_change, bend_change, rate_weight, bend_weight = regression
    # At the time of the fit, x is the mean age.
    now_z = mean_age**2 - moments.xx / count
    offset = moments.mean_lead + rate_change * mean_age + bend_change * now_z
    # Readings can be on a line by chance; the next one above it shows their possible delay.
    next_lead, _ = leads[min(count, len(leads) - 1)]
    variance = (next_lead - moments.mean_lead) ** 2 + min_variance
    error_factor = _ERROR_FACTOR + min(RECENT / len(leads), 1.0)
    offset_scale = 1 / count + mean_age**2 / rate_weight + now_z**2 / bend_weight
    rate_scale = 1 / rate_weight + (2 * mean_age) ** 2 / bend_weight
    error = error_factor * math.sqrt(variance * offset_scale)
    rate_error = error_factor * math.sqrt(variance * rate_scale)
    lowest_lead, _ = leads[0]
    return LowestFit(LeadFit(time, offset, rate, bend, error, rate_error), lowest_lead)


def fit_difference(differences: Sequence[tuple[float, float]]) -> LeadFit:
    """Fit a line to leads [s] of a clock over another one, given with their times [s].

    The rate that is likely between two crystals serves as a prior.
    """
    newest, _ = differences[-1]
    aged_leads = [(lead, newest - time) for time, lead in differences]
    moments = _moments(aged_leads)
    rate_weight = moments.xx + (MIN_ERROR / _EXPECTED_RATE) ** 2
    rate = moments.xy / rate_weight
    offset = moments.mean_lead + rate * moments.mean_age
    error = MIN_ERROR * math.sqrt(1 / len(aged_leads) + moments.mean_age**2 / rate_weight)
    rate_error = MIN_ERROR / math.sqrt(rate_weight)
    return LeadFit(newest, offset, rate, 0.0, error, rate_error)

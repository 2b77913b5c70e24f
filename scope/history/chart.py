"""A figure over time: control limits, what lies outside them, and when its trend meets the limit that the work sets."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta

import numpy as np

from scope.history.journal import Record

_RANGE = 2.66  # 3 / d2 for ranges of two: limits of single values about their mean, in mean moving ranges
_LEAST = 5  # values from which limits and a trend follow
_T95 = 2.0  # standard errors of the slope by which a trend must differ from none
_FURTHEST = 3650.0  # days ahead that are told


@dataclass(frozen=True, slots=True, eq=False)
class Chart:
    """One figure over time."""

    name: str
    when: tuple[str, ...]
    values: tuple[float, ...]
    centre: float  # mean; NaN for fewer than five values
    low: float
    high: float
    outside: tuple[int, ...]  # places of values beyond the limits
    slope: float  # a day; NaN where no trend is clear
    recalibrate_by: str  # ISO date at which the trend meets the limit; empty where it does not


def chart_of(name: str, records: Sequence[Record], *, limit: float | None = None, shift: bool = False) -> Chart:
    """Chart of single values of one figure.

    Parameters
    ----------
    name : str
        Of the figure; records without it are left out.
    records : sequence of Record
        The oldest first.
    limit : float, optional
        What the figure may reach, as [accept] says; the trend's meeting with it is "recalibrate by".
    shift : bool
        Values are told as differences from the first of them, and the limit holds on both sides: how far a sheet has moved.

    Returns
    -------
    Chart
        Limits are the mean +- 2.66 mean moving ranges (individuals chart, ISO 7870-2:2023). The trend is a least-squares line, told
        where its slope exceeds two standard errors; a drift that is not steady is not foreseen by it.
    """
    known = [(r.when, r.figures[name]) for r in records if name in r.figures and _day(r.when) is not None]
    when, values = tuple(w for w, _ in known), np.array([v for _, v in known])
    if shift and len(values):
        values = values - values[0]
    nothing = float("nan")
    if len(values) < _LEAST:
        return Chart(name, when, tuple(values.tolist()), nothing, nothing, nothing, (), nothing, "")
    centre, spread = float(values.mean()), _RANGE * float(np.abs(np.diff(values)).mean())
    low, high = centre - spread, centre + spread
    outside = tuple(int(k) for k in np.flatnonzero((values < low) | (values > high)))
    slope, by = _trend(np.array([_day(w) or 0.0 for w in when]), values, limit, shift=shift)
    return Chart(name, when, tuple(values.tolist()), centre, low, high, outside, slope, by)


def _trend(days: np.ndarray, values: np.ndarray, limit: float | None, *, shift: bool) -> tuple[float, str]:
    span = days - days.mean()
    square = float(span @ span)
    if square <= 0.0:
        return float("nan"), ""
    slope = float(span @ (values - values.mean())) / square
    rest = values - values.mean() - slope * span
    error = float(np.sqrt(rest @ rest / max(len(values) - 2, 1) / square))
    if abs(slope) <= _T95 * error:
        return float("nan"), ""
    if limit is None or (slope <= 0.0 and not shift):
        return slope, ""
    limit = limit if slope > 0.0 else -limit
    ahead = (limit - (values.mean() + slope * (days[-1] - days.mean()))) / slope
    if not ahead < _FURTHEST:
        return slope, ""
    date = datetime.fromtimestamp(0, UTC) + timedelta(days=float(days[-1] + max(ahead, 0.0)))
    return slope, date.date().isoformat()


def _day(when: str) -> float | None:
    """Days since 1970 of a moment; None for a text that is none."""
    try:
        moment = datetime.fromisoformat(when)
    except ValueError:
        return None
    return (moment if moment.tzinfo else moment.replace(tzinfo=UTC)).timestamp() / 86400.0

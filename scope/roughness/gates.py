"""Which areal parameters are given, how sure each is, and why the others are withheld."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from scope.heightmap import ISOTROPIC
from scope.roughness.estimate import LINEAR, SHARES, Estimate, MeasuredMap, estimate
from scope.roughness.noise import Noise
from scope.roughness.profile_noise import LARGEST_NOISE_SHARE
from scope.roughness.table import AREAL, Parameter

_ONE_SIDED = "one-sided: the gaps may hide a greater value"
_LARGEST_TURN = 30.0  # degrees, k = 2: a direction less certain than this is none
_SLOPE_UNCERTAINTY = 0.10  # k = 2: slopes that noise leaves less certain than this are withheld
_SLOPE_NOISE = 12.0  # raw over clean: beyond, noise is 99.3 % of the squared slopes
_SLOPE_SAMPLING = 0.80  # of Sdq left at twice the pitch: below, the pitch decides it


def trust_in_sigma(measured: MeasuredMap, found: Estimate, noise: Noise) -> dict[str, float]:
    """How far each parameter moves when a predicted sigma is wrong by its standard uncertainty."""
    if noise.source != "sigma" or noise.trust == 0.0:
        return dict.fromkeys(found.clean, 0.0)
    factor = (1.0 + noise.trust) ** 2
    more = replace(measured, noise_variance=factor * measured.noise_variance, slope_noise=factor * measured.slope_noise)
    moved = estimate(more, with_raw=False).clean
    return {
        key: abs(moved[key] - value) if math.isfinite(moved[key]) else math.inf for key, value in found.clean.items()
    }


def areal_table(
    measured: MeasuredMap,
    found: Estimate,
    noise: Noise,
    spread: dict[str, float],
    trust: dict[str, float],
    gap_share: float,
) -> dict[str, Parameter]:
    """Table of the areal parameters: each with its uncertainty (k = 2), or with the reason why it is withheld.

    ``spread`` and ``trust`` are the standard uncertainties from sampling_uncertainty and from the trust in sigma, by parameter;
    ``gap_share`` is the share (0 to 1) of the lattice without a height.
    """
    table = {}
    for key, definition in AREAL.items():
        value, raw = found.clean[key], found.raw[key]
        reason = _withheld(key, found, noise)
        note = ""
        extra = 0.0 if reason else _model_error(key, measured, found, noise)
        if key in {"Sp", "Sv", "Sz"} and gap_share > 0.01:
            note = _ONE_SIDED
        elif key in {"Sdq", "Sdr"} and measured.slope_index != (0.0, 0.0):
            note = (
                f"behind a Gaussian S-filter of {measured.slope_index[0]:.3g} x {measured.slope_index[1]:.3g} mm; "
                f"the {100.0 * (1.0 - 1.0 / measured.slope_attenuation.factor):.1f} % of Sdq that it took are put back"
            )
        expanded = None
        if spread and not reason and math.isfinite(spread[key]):
            expanded = 2.0 * math.sqrt(spread[key] ** 2 + trust[key] ** 2 + extra**2)
        if key == "Std" and not reason and expanded is not None and expanded > _LARGEST_TURN:
            reason = f"the direction is uncertain by {expanded:.0f} degrees (k = 2, limit {_LARGEST_TURN:g}): choose a larger region"
        if key in {"Sdq", "Sdr"} and not reason:
            reason = _slope_gate(measured, found, expanded if key == "Sdq" else None)
        table[key] = Parameter(
            value=None if reason else value,
            uncertainty=None if reason or expanded is None or not math.isfinite(expanded) else expanded,
            unit=definition.unit,
            reason=reason,
            raw=raw if math.isfinite(raw) else None,
            note=note,
            clause=definition.clause,
            at_least=note == _ONE_SIDED and not reason,
        )
    if table["Sdq"].value is None and table["Sdr"].value is not None:
        table["Sdr"] = replace(table["Sdr"], value=None, uncertainty=None, reason=table["Sdq"].reason)
    return table


def _model_error(key: str, measured: MeasuredMap, found: Estimate, noise: Noise) -> float:
    """Standard uncertainty of what the corrections take for granted.

    What noise did to heights and volumes was found on smoothed heights, whose shape is not quite the surface's: a part of
    what was taken away stays in doubt, the more the farther the surface is from a Gaussian, and a quarter for extremes.
    What smoothing took from slopes was put back to about half of itself; what the stripe's width averages, put back by
    ranging or here, is known to half of itself.
    """
    clean, raw = found.clean, found.raw
    if key in {"Sdq", "Sdr"}:
        return (1.0 if key == "Sdq" else 2.0) * measured.slope_attenuation.doubt * clean[key]
    width = 0.0
    if key == "Sq" or key in LINEAR:
        width = 0.5 * measured.stripe_loss(clean["Sq"]) * clean[key]
    if noise.source == "unknown":
        return width
    if key in {"Sp", "Sv", "Sz"}:
        return math.hypot(width, 0.25 * abs(raw[key] - clean[key]))
    if key in SHARES:
        return max(abs(raw[key] - clean[key]), 1.0 - (clean["Sq"] / raw["Sq"]) ** 2)
    if key in LINEAR:
        excess = min(1.0, abs(clean["Ssk"]) / 2.0 + abs(clean["Sku"] - 3.0) / 3.0)
        return math.hypot(width, (0.05 + 0.8 * excess) * abs(raw[key] - clean[key]))
    return width


def _withheld(key: str, found: Estimate, noise: Noise) -> str:
    """Why a parameter does not exist here; empty where it does."""
    if math.isnan(found.clean["Sq"]):
        return f"the noise of {noise.floor:.3g} mm is all of the measured Sq of {found.raw['Sq']:.3g} mm"
    share = 1.0 - (found.clean["Sq"] / found.raw["Sq"]) ** 2
    if key in {"Ssk", "Sku"} and share > LARGEST_NOISE_SHARE:
        return f"noise is {100.0 * share:.0f} % of the variance (limit {100.0 * LARGEST_NOISE_SHARE:g} %)"
    if math.isfinite(found.clean[key]):
        return ""
    if key == "Str":
        return f"the correlation falls to 0.2 within the patch in some directions only; Str is at most {found.texture.bound:.3g}"
    if key == "Std":
        if math.isfinite(found.texture.Str) and found.texture.Str >= ISOTROPIC:
            return f"the surface is isotropic (Str {found.texture.Str:.2f}): it has no direction"
        return "the correlation leaves the direction open"
    if key == "Sal":
        return "the correlation never falls to 0.2 within the patch: choose a larger region"
    if key in {"Sdq", "Sdr"}:
        return "noise: what it predicts of the slopes is as much as was measured"
    return "nothing follows from these heights"


def _slope_gate(measured: MeasuredMap, found: Estimate, expanded: float | None) -> str:
    """Why slopes are withheld: decided by noise or by the pitch; empty where they stand."""
    clean, raw = found.clean["Sdq"], found.raw["Sdq"]
    if measured.slope_index != (0.0, 0.0):
        if raw > _SLOPE_NOISE * clean:
            return f"noise: the measured Sdq of {raw:.3g} is {raw / clean:.0f} times what noise leaves of it (limit {_SLOPE_NOISE:g})"
        if expanded is not None and math.isinf(expanded):
            return "noise: a sigma wrong by its uncertainty accounts for all of the slopes; give a repeat scan"
        if expanded is not None and expanded > _SLOPE_UNCERTAINTY * clean:
            return (
                f"noise: Sdq {clean:.3g} would be uncertain by {100.0 * expanded / clean:.0f} % "
                f"(limit {100.0 * _SLOPE_UNCERTAINTY:g} %, k = 2)"
            )
    left = _coarser_slope(measured)
    if left < _SLOPE_SAMPLING:
        return f"sampling: at twice the pitch Sdq falls to {100.0 * left:.0f} %, so the pitch decides it"
    return ""


def _coarser_slope(measured: MeasuredMap) -> float:
    """Sdq at twice the pitch over Sdq."""
    first, second = measured.slope_maps
    totals = []
    for every in (1, 2):
        square = 0.0
        for axis in (0, 1):
            a, b = (np.moveaxis(values, axis, 0) for values in (first, second))
            product = (a[every:] - a[:-every]) * (b[every:] - b[:-every])
            known = np.isfinite(product)
            mean = float(product[known].mean()) / (every * measured.pitch[axis]) ** 2 if known.any() else math.nan
            square += mean - float(measured.slope_noise[axis]) / every**2 if every == 1 else mean
        totals.append(square)
    return math.sqrt(totals[1] / totals[0]) if totals[0] > 0.0 and totals[1] > 0.0 else 1.0

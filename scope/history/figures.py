"""Which figures of a result are worth to be watched over time."""

from __future__ import annotations

from typing import Any

import numpy as np

Figures = dict[str, float]


def calibration_figures(result: dict[str, Any]) -> Figures:
    """Of what ``scope calibrate --json`` prints: error of planes held out, and where each sheet of light lies."""
    held = _numbers(plane.get("heldout_mm") for plane in result["planes"])
    figures = {"planes": float(len(result["planes"])), "faults": float(len(result["faults"]))}
    if held:
        figures["heldout_mm"] = float(np.sqrt(np.mean(np.square(held))))
    if result.get("interplane_px") is not None:
        figures["interplane_px"] = float(result["interplane_px"])
    for name, laser in result["lasers"].items():
        normal = [float(x) for x in laser["normal"]]
        figures |= {f"{name}.rms_mm": float(laser["rms_mm"]), f"{name}.offset_mm": float(laser["offset"])}
        figures |= {f"{name}.normal_{axis}": value for axis, value in zip("xyz", normal, strict=True)}
    return figures


def verification_figures(result: dict[str, Any]) -> Figures:
    """Of what ``scope verify --json`` prints."""
    rms = _numbers(plane.get("rms_mm") for plane in result["planes"])
    figures = {"faults": float(len(result["faults"]))}
    return {**figures, "heldout_mm": float(np.sqrt(np.mean(np.square(rms))))} if rms else figures


def scan_figures(result: dict[str, Any]) -> Figures:
    """Of what ``scope scan --json`` prints."""
    keys = ("frames", "points", "sigma_mm", "sigma_cal_mm")
    return {key: float(result[key]) for key in keys if result.get(key) is not None}


def check_figures(result: dict[str, Any]) -> Figures:
    """Of what ``scope check --json`` prints: the artefact's errors."""
    keys = ("error_mm", "form_mm", "linearity_percent", "repeatability_mm")
    return {key: float(result[key]) for key in keys if result.get(key) is not None}


def _numbers(values: Any) -> list[float]:
    return [float(value) for value in values if value is not None and np.isfinite(value)]

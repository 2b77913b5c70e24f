"""What a command answers in JSON, as the columns of a row."""

from __future__ import annotations

from typing import Any

import numpy as np

_AXES = ("x", "y", "z")
_ANGLES = ("roll", "pitch", "yaw")
_TIMES = {"seconds", "origin"}  # a row does not tell them: it would not be the same again
_LONGEST = 3  # numbers of a list that become columns


def figures_of(label: str, command: str, result: Any) -> dict[str, Any]:
    """Columns ``label.name`` of what a command answered; empty where it answered nothing.

    Figures with an uncertainty have it beside them: ``name`` and ``name.u``, as the command gives it (k = 2 but for a pose, whose
    ``.sd`` are standard deviations). Of a pose there are its translation (mm) and angles (degrees), in the frame of the robot, else of the camera,
    else of the cloud.
    """
    if not isinstance(result, dict):
        return {}
    return _of_pose(label, result) if command == "pose" else dict(_walk(label, result))


def _of_pose(label: str, result: dict[str, Any]) -> dict[str, Any]:
    columns: dict[str, Any] = {f"{label}.{name}": result.get(name) for name in ("found", "ambiguous")}
    notations = result.get("notations") or {}
    frame = next((f for f in ("robot", "camera", "cloud") if f"{f}_from_model" in notations), None)
    columns[f"{label}.frame"] = frame
    told = notations.get(f"{frame}_from_model", {})
    columns |= {f"{label}.{a}_mm": v for a, v in zip(_AXES, told.get("translation_mm", [None] * 3), strict=True)}
    columns |= {f"{label}.{a}_deg": v for a, v in zip(_ANGLES, told.get("rpy_deg", [None] * 3), strict=True)}
    covariance = result.get("covariance")
    spread: list[float | None] = [None, None]
    if covariance is not None:
        sd = np.sqrt(np.diag(np.asarray(covariance, dtype=np.float64)))
        spread = [float(sd[:3].max()), float(np.degrees(sd[3:].max()))]
    columns |= {f"{label}.translation_mm.sd": spread[0], f"{label}.rotation_deg.sd": spread[1]}
    for name in ("rmse_mm", "score", "points", "why"):
        columns[f"{label}.{name}"] = result.get(name)
    variant = result.get("variant")
    return columns | (dict(_walk(f"{label}.variant", variant)) if isinstance(variant, dict) else {})


def _walk(prefix: str, value: Any) -> list[tuple[str, Any]]:
    if isinstance(value, dict):
        if {"value", "uncertainty"} <= set(value):
            return [(prefix, value["value"]), (f"{prefix}.u", value["uncertainty"])]
        return [pair for key, item in value.items() if key not in _TIMES for pair in _walk(f"{prefix}.{key}", item)]
    if isinstance(value, list | tuple):
        if value and all(isinstance(item, dict) and "name" in item for item in value):
            named = [(str(item["name"]), {k: v for k, v in item.items() if k != "name"}) for item in value]
            return [pair for name, item in named for pair in _walk(f"{prefix}.{name}", item)]
        if all(isinstance(item, str) for item in value):
            return [(prefix, "; ".join(value))] if value else []
        if len(value) <= _LONGEST and all(isinstance(item, int | float) for item in value):
            return [(f"{prefix}.{k}", item) for k, item in enumerate(value)]
        return []
    return [(prefix, value)]

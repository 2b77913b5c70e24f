"""A scene as bytes for the browser: a header in JSON, columns as differences in planes of bytes, all of it deflated.

Neighbours in scan order differ little, so that their differences deflate to about a byte a coordinate. Every number is kept
to a step that is stated in the header, far finer than what it is uncertain by.
"""

from __future__ import annotations

import json
import struct
import zlib
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from calibration.geometry import Array, Bools
from scope.viewer.scene import Layer, Scalar, Scene

_FINEST = 1e-4  # mm: step of coordinates in a scene of 100 mm and more
_LEVELS = 2000  # steps at least of a scalar over its usual range
_LONGEST = 120  # characters of a name
_QUICK = 400_000  # points from which deflating is to be quick


@dataclass(frozen=True, slots=True, eq=False)
class _Column:
    start: float
    step: float
    folded: NDArray[
        np.uint32
    ]  # (N,) differences of steps from `start`, their signs folded in: 0, -1, 1, -2 ... as 0, 1, 2, 3
    gaps: Bools | None  # (N,) where nothing is known

    def told(self) -> dict[str, Any]:
        return {"start": self.start, "step": self.step, "planes": self.planes, "gaps": self.gaps is not None}

    @property
    def planes(self) -> int:
        top = int(self.folded.max(initial=0))
        return (top.bit_length() + 7) // 8

    def bytes(self) -> bytes:
        """Planes of bytes, the lowest first, then the mask of gaps."""
        planes = self.folded.astype("<u4", copy=False).view(np.uint8).reshape(-1, 4)
        gaps = b"" if self.gaps is None else np.packbits(self.gaps).tobytes()
        return b"".join(planes[:, k].tobytes() for k in range(self.planes)) + gaps


def scene_bytes(scene: Scene) -> bytes:
    """A scene as one deflated block, which `viewer.js` reads."""
    low, high = scene.bounds()
    centre = (low + high) / 2
    longest = float((high - low).max())
    step = max(min(_FINEST, _power_below(max(longest, 1e-6) / 2**20)), 10.0 * _power_below(longest / 2**29))
    axes = [_column(scene.points[:, k] - centre[k], step) for k in range(3)]
    kept = [scalar for scalar in scene.scalars if np.isfinite(scalar.values).any() or scalar.names]
    columns = [_column(scalar.values, _step_of(scalar)) for scalar in kept]
    rows = [] if scene.rows is None else [_column(scene.rows.astype(np.float64) + 1.0, 1.0)]
    listed_already = {scalar.name for scalar in kept}
    places = (
        [_place_told(k, low, high, step) for k in (2, 0, 1) if "xyz"[k] not in listed_already] if len(scene) else []
    )
    listed = [_told(s, c) for s, c in zip(kept, columns, strict=True)]
    header = {
        "points": len(scene), "of": scene.of or len(scene), "centre": centre.tolist(), "low": (low - centre).tolist(), "high": (high - centre).tolist(),
        "stretch": list(scene.stretch), "look": [side.tolist() for side in scene.look], "decimals": _decimals(step),
        "axes": [column.told() for column in axes], "columns": listed, "places": places, "rows": rows[0].told() if rows else None,
        "shown": listed[0]["name"] if listed else "z", "layers": [_layer(layer) for layer in scene.layers],
    }  # fmt: skip
    text = json.dumps(header, allow_nan=False).encode("utf-8")
    blocks = [struct.pack("<I", len(text)), text, *(column.bytes() for column in (*axes, *columns, *rows))]
    return zlib.compress(b"".join(blocks), 6 if len(scene) < _QUICK else 3)


def _column(values: Array, step: float) -> _Column:
    known = np.isfinite(values)
    start = float(values[known][0]) if known.any() else 0.0
    filled = values if known.all() else np.where(known, values, start)
    whole = np.clip(np.rint((filled - start) / step), -(2**29), 2**29).astype(np.int32)
    change = np.diff(whole, prepend=np.int32(0))
    return _Column(start, step, ((change << 1) ^ (change >> 31)).view(np.uint32), None if known.all() else ~known)


def _step_of(scalar: Scalar) -> float:
    if scalar.kind == "names":
        return 1.0
    known = scalar.values[np.isfinite(scalar.values)]
    low, high = scalar.usual
    step = _power_below(max(high - low, 1e-12) / _LEVELS)
    if len(known) and np.array_equal(known, np.rint(known)):
        step = max(1.0, step)
    largest = float(np.abs(known).max(initial=0.0))
    return max(step, 10.0 * _power_below(largest / 2**28)) if largest > 0 else step


def _power_below(value: float) -> float:
    return float(10.0 ** np.floor(np.log10(max(value, 1e-15)) + 1e-9))


def _decimals(step: float) -> int:
    return int(np.clip(np.ceil(-np.log10(step) - 1e-9), 0, 9))


def _told_decimals(scalar: Scalar, step: float) -> int:
    """As many as tell a two hundredth of the usual range; of whole numbers none."""
    low, high = scalar.usual
    least = 2 if scalar.unit == "px" else 0
    return min(_decimals(step), max(least, _decimals(_power_below(max(high - low, 1e-12) / 200))))


def _told(scalar: Scalar, column: _Column) -> dict[str, Any]:
    known = scalar.values[np.isfinite(scalar.values)]
    whole = [float(known.min()), float(known.max())] if len(known) else [0.0, 1.0]
    return {
        **column.told(), "name": scalar.name[:_LONGEST], "label": (scalar.label or scalar.name)[:_LONGEST], "unit": scalar.unit,
        "kind": scalar.kind, "names": [name[:_LONGEST] for name in scalar.names], "decimals": _told_decimals(scalar, column.step),
        "usual": list(scalar.usual), "whole": whole,
    }  # fmt: skip


def _place_told(axis: int, low: Array, high: Array, step: float) -> dict[str, Any]:
    name, limits = "xyz"[axis], [float(low[axis]), float(high[axis])]
    limits = limits if limits[1] > limits[0] else [limits[0], limits[0] + 1e-6]
    return {"name": name, "label": name, "unit": "mm", "kind": "sequential", "names": [], "axis": axis, "decimals": _decimals(step),
            "usual": limits, "whole": limits}  # fmt: skip


def _layer(layer: Layer) -> dict[str, Any]:
    told: dict[str, Any] = {
        "name": layer.name[:_LONGEST], "role": layer.role, "number": layer.number, "bold": layer.bold, "shown": layer.shown,
    }  # fmt: skip
    if layer.lines is not None:
        told["lines"] = np.round(layer.lines.ravel(), 4).tolist()
    elif layer.vertices is not None and layer.faces is not None:
        told["vertices"] = np.round(layer.vertices.ravel(), 4).tolist()
        told["faces"] = layer.faces.ravel().tolist()
    return told

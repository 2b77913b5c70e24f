"""Values of a JSON file, checked as they are read: ``ValueError`` or ``TypeError`` for what cannot be meant."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, TypeVar

import numpy as np

from calibration.geometry import Array, Pose

_HIGHEST = 20  # order of a polynomial that a file may ask for
T = TypeVar("T")


def array(content: Any, *shape: int, known: bool = True) -> Array:
    """Array of a shape (-1: any length), finite where it must be ``known``; null becomes NaN."""
    values = np.array(content, dtype=np.float64)
    if values.size == 0:
        values = values.reshape([max(n, 0) for n in shape])
    if values.ndim != len(shape) or any(n not in {-1, m} for n, m in zip(shape, values.shape, strict=True)):
        raise ValueError(f"an array of shape {shape} was expected, found {values.shape}")
    if known and not np.isfinite(values).all():
        raise ValueError("a number that must be known is null or infinite")
    return values


def unit(content: Any) -> Array:
    """Unit vector (3,)."""
    vector = array(content, 3)
    if abs(float(np.linalg.norm(vector)) - 1.0) > 1e-6:
        raise ValueError(f"a unit vector was expected, found length {np.linalg.norm(vector):g}")
    return vector


def rotation(content: Any) -> Array:
    """Rotation matrix (3, 3)."""
    turn = array(content, 3, 3)
    Pose.from_matrix(Pose(turn, np.zeros(3)).matrix, tolerance=1e-6)  # its ValueError is this rig's
    return turn


def positive(content: Any) -> float:
    """Number above zero."""
    value = float(content)
    if not 0 < value < np.inf:
        raise ValueError(f"a positive number was expected, found {value}")
    return value


def order(content: Any) -> int:
    """Order of a polynomial."""
    value = int(content)
    if not 0 <= value <= _HIGHEST:
        raise ValueError(f"an order from 0 to {_HIGHEST} was expected, found {value}")
    return value


def one_of(content: Any, allowed: set[str]) -> str:
    """One of the words allowed."""
    if content not in allowed:
        raise ValueError(f"{content!r} is none of {', '.join(sorted(allowed))}")
    return str(content)


def number(content: Any) -> float:
    """Number; null is NaN."""
    return float("nan") if content is None else float(content)


def blur(content: Any) -> float:
    """Blur of a lens, px; NaN where unknown."""
    value = number(content)
    if value == value and not 0.1 < value < 50.0:
        raise ValueError(f"a blur of {value} px")
    return value


def each(content: Any, read: Callable[[Any], T]) -> tuple[T, ...]:
    """What ``read`` makes of each item."""
    return tuple(read(item) for item in content)

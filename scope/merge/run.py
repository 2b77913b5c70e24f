"""Scans to one cloud: poses, comparison of overlaps, verdict."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from calibration.errors import FileError
from calibration.geometry import Array, Pose
from scope.cloud import ScanCloud
from scope.errors import MeasurementError
from scope.export import write_scalars
from scope.merge.graph import adjusted, placed
from scope.merge.joined import joined
from scope.merge.overlap import PairOverlap, compared, contact
from scope.merge.patch import Patch, prepared

_MOST = 64  # scans
_LARGEST = 16 << 20  # bytes of a file of poses


@dataclass(frozen=True, slots=True, eq=False)
class Merged:
    """Several scans in one frame."""

    names: tuple[str, ...]
    poses: tuple[Pose, ...] | None  # whole_from_cloud; None: not determined
    known: bool  # the poses were given
    cloud: ScanCloud | None
    pairs: tuple[PairOverlap, ...]
    deviation: Array | None  # (N,) mm of each point of the cloud from the other scans, NaN where they do not overlap
    passed: bool
    why: str

    sizes: tuple[int, ...] = ()  # points of each

    @property
    def disagreement_mm(self) -> float:
        """Rms of the gaps of all overlaps; NaN where nothing overlaps."""
        points = sum(pair.points for pair in self.pairs)
        return float(np.sqrt(sum(p.points * p.rms_mm**2 for p in self.pairs) / points)) if points else float("nan")


def merge(
    clouds: Sequence[ScanCloud],
    names: Sequence[str],
    *,
    poses: Sequence[Pose] | None = None,
    refine: bool = False,
    tolerance: float | None = None,
) -> Merged:
    """Join scans of one object.

    Parameters
    ----------
    clouds : sequence of ScanCloud
        Two or more, mm.
    names : sequence of str
        What they are called.
    poses : sequence of Pose, optional
        whole_from_cloud of each. Without them they are found by the shapes, in the frame of the first.
    refine : bool
        Whether known poses are adjusted to the overlaps.
    tolerance : float, optional
        mm by which two scans may be apart where they overlap (median of a pair). Without it, what both calibrations explain
        with k = 2, where the clouds tell it.

    Raises
    ------
    MeasurementError
        Fewer than two scans, more than 64, or scans of too few points.
    ValueError
        Another number of poses than of clouds.
    """
    if not 2 <= len(clouds) <= _MOST:
        raise MeasurementError(f"{len(clouds)} scans; two to {_MOST} are merged")
    if poses is not None and len(poses) != len(clouds):
        raise ValueError(f"{len(poses)} poses for {len(clouds)} clouds; one a cloud is needed")
    patches = [prepared(cloud, name) for cloud, name in zip(clouds, names, strict=True)]
    if poses is None:
        found = placed(patches)
        if found.poses is None:
            return Merged(tuple(names), None, False, None, (), None, False, found.why)
        at = found.poses
    else:
        at = tuple(poses)
        if refine:
            at = adjusted(patches, at, reach=_reach(patches))[0]
    pairs = [
        pair for i in range(len(patches)) for j in range(i + 1, len(patches))
        if (pair := compared(patches[i], patches[j], at[j].inverse @ at[i], reach=_reach(patches))) is not None
    ]  # fmt: skip
    passed, why = _verdict(pairs, [bool(p.shared.any()) for p in patches], poses is not None, tolerance)
    cloud = joined(clouds, at, names)
    return Merged(tuple(names), at, poses is not None, cloud, tuple(pairs), _deviation(clouds, patches, at), passed, why,
                  tuple(len(c) for c in clouds))  # fmt: skip


def read_poses(path: Path, count: int) -> list[Pose]:
    """Poses whole_from_cloud (mm) of a JSON file: a list of 4x4, or an object with it under ``poses``, as --json prints.

    Raises
    ------
    FileError
        No such file, no JSON, another number of poses, or a matrix that is not rigid.
    """
    try:
        if path.stat().st_size > _LARGEST:
            raise FileError(f"{path}: {path.stat().st_size} bytes; a JSON file with {count} matrices is expected")
        held: Any = json.loads(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise FileError(f"{path}: cannot be read ({error.strerror}); check the path") from error
    except (ValueError, RecursionError) as error:
        raise FileError(f"{path}: is no JSON ({str(error)[:80]}); give a list of 4x4 matrices") from error
    rows = held.get("poses") if isinstance(held, dict) else held
    if not isinstance(rows, list) or len(rows) != count:
        found = len(rows) if isinstance(rows, list) else "no"
        raise FileError(
            f"{path}: {found} poses for {count} clouds; give a list of 4x4 matrices whole_from_cloud, mm, one each"
        )
    try:
        return [Pose.from_matrix(np.array(row, dtype=np.float64), tolerance=1e-3) for row in rows]
    except (ValueError, TypeError) as error:
        raise FileError(f"{path}: a matrix is no pose: {error}; give [[r, r, r, x], ..., [0, 0, 0, 1]], mm") from error


def _reach(patches: Sequence[Patch]) -> float:
    return max(0.01 * max(p.size for p in patches), 0.5 * max(p.spacing for p in patches))


def _verdict(
    pairs: Sequence[PairOverlap], told: Sequence[bool], known: bool, tolerance: float | None
) -> tuple[bool, str]:
    if not pairs:
        return known, "nothing overlaps, so that the given poses cannot be checked" if known else "nothing overlaps"
    worst = max(pairs, key=lambda p: abs(p.offset_mm))
    text = (
        f"where {worst.first} and {worst.second} overlap they are {abs(worst.offset_mm):.3g} mm apart (median; "
        f"rms {worst.rms_mm:.3g} mm)"
    )
    if tolerance is not None:
        if abs(worst.offset_mm) > tolerance:
            return False, f"{text}; allowed {tolerance:g}"
        return True, f"{text}; allowed {tolerance:g}"
    if all(told) and known:
        beyond = [p for p in pairs if not p.within]
        if beyond:
            bad = max(beyond, key=lambda p: abs(p.offset_mm) / (p.shared_mm + 1e-6))
            return False, (
                f"{bad.first} and {bad.second} are {abs(bad.offset_mm):.3g} mm apart where they overlap (median), and their "
                f"calibrations explain {2 * bad.shared_mm:.2g} mm (k = 2): one calibration, or a pose, is wrong; check both with "
                "an artefact (scope check)"
            )
    return True, text


def _deviation(clouds: Sequence[ScanCloud], patches: Sequence[Patch], at: Sequence[Pose]) -> Array:
    """Gap (N,) mm of every point to the other scans, the nearest where there are several."""
    found = []
    for i, (cloud, patch) in enumerate(zip(clouds, patches, strict=True)):
        best = np.full(len(cloud), np.nan)
        if len(patch.points) == len(cloud):
            for j, other in enumerate(patches):
                if j == i:
                    continue
                gap = contact(patch, other, at[j].inverse @ at[i], reach=_reach(patches), rows=np.arange(len(cloud)))
                nearer = ~(np.abs(best[gap.rows]) < np.abs(gap.gap))
                best[gap.rows[nearer]] = gap.gap[nearer]
        found.append(best)
    return np.concatenate(found)


def write_map(path: Path, found: Merged) -> None:
    """Write the whole with ``deviation``: mm of each point from the other scans, NaN where one scan alone saw it."""
    if found.cloud is None or found.deviation is None:
        raise ValueError("a merge without an answer has no map")
    told = ("deviation from the other scans, mm", *(f"origin {line}" for line in found.cloud.origin))
    write_scalars(path, found.cloud.points, {"deviation": found.deviation}, told)

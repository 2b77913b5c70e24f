"""The uncertainty budget of a rig: what a single ranged point owes to the stripe, the camera, the sheet and the target.

After the GUM (JCGM 100:2008, 5.1 and 8): each source has a standard uncertainty, a sensitivity, and a share of the combined variance.
All are taken along the sighting ray, root mean square over the calibrated part of a sheet of light.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np

from calibration.geometry import Array
from calibration.rig import Rig
from calibration.sheet import Laser
from ranging.covariance import propagate
from scope.cloud import ScanCloud
from scope.errors import MeasurementError

COVERAGE = 2.0  # k of the expanded uncertainty
_GRID = 48  # pixels along the longer side of the image


@dataclass(frozen=True, slots=True)
class Source:
    """One line of a budget."""

    name: str
    kind: Literal["A", "B"]  # evaluated by statistics, or otherwise (GUM 4.2, 4.3)
    standard: float | None  # of the input, in ``unit``; None where it was not stated
    unit: str
    sensitivity: float  # mm along the ray for one unit
    why: str  # where it comes from, or why it is missing

    @property
    def contribution(self) -> float | None:
        """Mm, one standard deviation along the ray."""
        return None if self.standard is None else abs(self.sensitivity) * self.standard


@dataclass(frozen=True, slots=True)
class Budget:
    """The budget of one laser."""

    laser: str
    sources: tuple[Source, ...]
    points: int  # places of the sheet over which was averaged
    stand_off: tuple[float, float]  # mm, nearest and farthest of them

    @property
    def combined(self) -> float:
        """Mm, one standard deviation along the ray: root of the sum of squares of the contributions that are known."""
        return float(np.sqrt(sum((source.contribution or 0.0) ** 2 for source in self.sources)))

    @property
    def expanded(self) -> float:
        """Mm, k = 2."""
        return COVERAGE * self.combined

    @property
    def missing(self) -> tuple[str, ...]:
        """Sources that were not stated, and so are not in it."""
        return tuple(source.name for source in self.sources if source.standard is None)

    def share(self, source: Source) -> float | None:
        """Part of the combined variance, 0 to 1."""
        mm = source.contribution
        return None if mm is None or self.combined == 0 else (mm / self.combined) ** 2

    def as_json(self) -> dict[str, Any]:
        """What `scope certificate --json` gives."""
        return {
            "laser": self.laser,
            "sources": [
                {
                    "source": source.name,
                    "kind": source.kind,
                    "standard": source.standard,
                    "unit": source.unit,
                    "sensitivity_mm": source.sensitivity,
                    "contribution_mm": source.contribution,
                    "share": self.share(source),
                    "why": source.why,
                }
                for source in self.sources
            ],
            "combined_mm": self.combined,
            "expanded_mm": self.expanded,
            "coverage_factor": COVERAGE,
            "missing": list(self.missing),
            "stand_off_mm": list(self.stand_off),
        }


def uncertainty_budget(
    rig: Rig, clouds: Sequence[ScanCloud] = (), *, lengths_percent: float | None = None
) -> tuple[Budget, ...]:
    """Return the budget of every laser of a rig.

    Parameters
    ----------
    rig : Rig
    clouds : sequence of ScanCloud
        Scans by this rig, from which the noise of the stripe is taken; without any it is missing from the budget.
    lengths_percent : float, optional
        Standard uncertainty of the lengths that were stated to the calibration (pitch of the target, stand-offs), percent. Planes
        cannot see an error that all of them share, so that it has to be stated; without it it is missing.

    Raises
    ------
    MeasurementError
        A rig without lasers, a sheet that does not cross the calibrated volume, or a cloud of another rig.
    ValueError
        A percentage that is not a positive number.
    """
    if lengths_percent is not None and not 0 < lengths_percent < 100:
        raise ValueError(f"lengths_percent {lengths_percent:g} must lie between 0 and 100, percent")
    if not rig.lasers:
        raise MeasurementError("the rig has no laser, so that it ranges nothing; calibrate one, then certify")
    for cloud in clouds:
        if cloud.rig_sha256 != rig.sha256:
            raise MeasurementError(
                f"a cloud was ranged with the rig {cloud.rig_sha256[:12] or 'unknown'}, this rig is {rig.sha256[:12]}; give scans "
                "by this rig"
            )
    return tuple(_budget(rig, laser, clouds, lengths_percent) for laser in rig.lasers.values())


def _budget(rig: Rig, laser: Laser, clouds: Sequence[ScanCloud], lengths_percent: float | None) -> Budget:
    pixels, points, view = _places(rig, laser)
    across = 1 if laser.along == "rows" else 0
    sensitivity = _rms(_along(rig, laser, pixels, points, view, across))
    found = propagate(rig.camera, laser, pixels, points, np.zeros(len(points)), across, jacobian=True)
    if found.jacobian is None:
        raise MeasurementError("the rig's covariance is missing; calibrate again with this version")
    slopes = np.einsum("ni,nip->np", view, found.jacobian)
    split = len(rig.camera.covariance)
    by_camera, by_laser = slopes[:, :split], slopes[:, split:]
    camera = float(np.sqrt(np.einsum("np,pq,nq->n", by_camera, rig.camera.covariance, by_camera).mean()))
    sheet = float(np.sqrt(np.einsum("np,pq,nq->n", by_laser, laser.covariance, by_laser).mean()))
    noise = _stripe_noise(laser, clouds)
    distance = _rms(np.linalg.norm(points, axis=1))
    sources = (
        Source(
            "stripe",
            "A",
            None if noise is None else noise / sensitivity,
            "px",
            sensitivity,
            "no scan by this rig was given" if noise is None else "median sigma of the points of the scans given",
        ),
        Source("sighting rays", "A", camera, "mm", 1.0, "covariance of the camera: noise of the marks"),
        Source(
            "sheet of light", "A", sheet, "mm", 1.0, "covariance of the laser, with what its shape leaves unexplained"
        ),
        Source(
            "lengths of target and jig",
            "B",
            lengths_percent,
            "%",
            distance / 100.0,
            "stated"
            if lengths_percent is not None
            else "not stated; planes cannot see an error that all lengths share",
        ),
    )
    depth = points[:, 2]
    return Budget(laser.name, sources, len(points), (float(depth.min()), float(depth.max())))


def _places(rig: Rig, laser: Laser) -> tuple[Array, Array, Array]:
    """Pixels (N, 2), points (N, 3) and unit rays (N, 3) on the calibrated part of a sheet."""
    width, height = rig.camera.size
    step = max(width, height) / _GRID
    u, v = np.meshgrid(np.arange(step / 2, width, step), np.arange(step / 2, height, step))
    pixels = np.stack([u.ravel(), v.ravel()], axis=1)
    rays = rig.camera.rays(pixels)
    points = laser.sheet.intersect(rays).points
    inside = np.isfinite(points).all(axis=1) & rig.camera.volume.contains(points)
    if not inside.any():
        raise MeasurementError(
            f"laser {laser.name}: its sheet does not cross the calibrated volume; calibrate where it shines"
        )
    return pixels[inside], points[inside], rays.direction[inside]


def _along(rig: Rig, laser: Laser, pixels: Array, points: Array, view: Array, across: int) -> Array:
    """Mm along the ray for a pixel across the stripe (N,)."""
    moved = rig.camera.shift(pixels, points)[:, :, across]
    normal = laser.sheet.normal_at(points)
    return np.asarray(np.einsum("ni,ni->n", normal, moved) / np.einsum("ni,ni->n", normal, view))


def _stripe_noise(laser: Laser, clouds: Sequence[ScanCloud]) -> float | None:
    """Median sigma (mm) of a laser's points over all clouds."""
    sigma = [
        cloud.sigma[cloud.laser == cloud.laser_names.index(laser.name)]
        for cloud in clouds
        if laser.name in cloud.laser_names
    ]
    known = np.concatenate([np.zeros(0), *sigma])
    known = known[np.isfinite(known)]
    return float(np.median(known)) if len(known) else None


def _rms(values: Array) -> float:
    return float(np.sqrt(np.mean(np.square(values))))

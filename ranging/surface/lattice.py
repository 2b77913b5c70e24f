"""A scan as a lattice: frames by lines of the image, on which every point has its neighbours."""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np

from calibration.geometry import Array, Codes, Pose
from calibration.reason import Reason
from ranging.background import Noise
from ranging.stripe import Stripe
from ranging.triangulation import Triangulated

CONTEXT = 10  # frames before and after, at most, that are looked at to judge or correct one
SAMPLE = 8  # lines, of which one is looked at for the lattice's own measures
SPARSE = 5.0  # strides over the distance of points along the stripe, beyond which frames are no neighbours


@dataclass(frozen=True, slots=True, eq=False)
class MeasuredProfile:
    """One frame's points as one laser saw them, in the cloud frame; row i belongs to line i."""

    points: Array  # (L, 3) mm, NaN where there is none
    view: Array  # (L, 3) unit sighting rays
    moved: Array  # (L, 3) mm/px, of the ray at the point when the pixel moves across the stripe
    sheet: Array  # (L, 3) unit normals of the sheet of light
    camera: Array  # (3,) mm
    sigma: Array  # (L,) mm along the ray
    sigma_cal: Array  # (L,) mm along the ray
    reason: Codes  # (L,)
    position: Array  # (L,) px
    sigma_px: Array  # (L,) px
    width: Array  # (L,) px
    peak: Array  # (L,) grey levels
    asymmetry: Array  # (L,)
    noise: Array  # (3,) electrons a grey level, grey levels squared without light, contrast of speckle

    @classmethod
    def of(cls, found: Triangulated, stripe: Stripe, cloud_from_c: Pose, camera: Array) -> MeasuredProfile:
        """Put a frame's points into the cloud frame; ``camera`` (3,) mm is in C."""
        turn = cloud_from_c.rotation.T
        return cls(
            points=cloud_from_c.apply(found.points),
            view=found.view @ turn,
            moved=found.moved @ turn,
            sheet=found.sheet @ turn,
            camera=cloud_from_c.apply(camera),
            sigma=found.sigma,
            sigma_cal=found.sigma_cal,
            reason=np.where(stripe.reason == Reason.RANGED, found.reason, stripe.reason).astype(np.uint8),
            position=stripe.position,
            sigma_px=stripe.sigma,
            width=stripe.width,
            peak=stripe.peak,
            asymmetry=stripe.asymmetry,
            noise=_noise(stripe.noise, stripe.speckle),
        )


@dataclass(frozen=True, slots=True, eq=False)
class Lattice:
    """F successive frames: the arrays of `MeasuredProfile`, with a first axis more."""

    points: Array
    view: Array
    moved: Array
    sheet: Array
    camera: Array
    sigma: Array
    sigma_cal: Array
    reason: Codes
    position: Array
    sigma_px: Array
    width: Array
    peak: Array
    asymmetry: Array
    noise: Array

    @classmethod
    def of(cls, frames: list[MeasuredProfile]) -> Lattice:
        """Stack frames, one at least."""
        return cls(**{f.name: np.stack([getattr(frame, f.name) for frame in frames]) for f in fields(MeasuredProfile)})

    def rows(self, first: int, last: int) -> Lattice:
        """Frames ``first`` to ``last`` - 1."""
        return Lattice(**{f.name: getattr(self, f.name)[first:last] for f in fields(self)})

    @property
    def moves(self) -> bool:
        """Whether frames lie beside each other on one surface, so that one tells something about the next.

        They must be farther apart than their noise, and not so far that a patch across them would skip what lies between
        (a turntable in steps of 10 degrees, say): at most ``SPARSE`` times the distance of points along the stripe.
        """
        some = self.sigma[:, ::SAMPLE]
        known = np.isfinite(some)
        if not known.any():
            return False
        stride = self.step(0)
        return stride > 3.0 * float(np.median(some[known])) and stride <= SPARSE * self.step(1)

    def step(self, axis: int) -> float:
        """Median distance, mm, between neighbours from frame to frame (0) or from line to line (1); 0 where unknown.

        One line in `SAMPLE` is looked at.
        """
        if axis == 0:
            gap = np.diff(self.points[:, ::SAMPLE], axis=0)
        else:
            gap = self.points[:, 1::SAMPLE] - self.points[:, : self.points.shape[1] - 1 : SAMPLE]
        length = np.linalg.norm(gap, axis=2)
        known = np.isfinite(length)
        return float(np.median(length[known])) if known.any() else 0.0


def _noise(noise: Noise | None, speckle: float) -> Array:
    if noise is None:
        return np.array([np.inf, 1.0, speckle])
    return np.array([noise.gain_e, noise.read_noise**2 + 1.0 / 12.0, speckle])

"""One image's points as the laser's stripe gave them: what a live view and a robot read, frame by frame."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from calibration.geometry import Array, Codes
from calibration.notebook import Picture, Shown, Summary, number, scatter
from calibration.reason import Reason
from ranging.stripe import Stripe
from ranging.triangulation import Triangulated


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class Profile(Shown):
    """Points of one image in C, one row a line of the image; rows without a point are NaN and ``reason`` says why."""

    points: Array  # (L, 3) mm, in C
    sigma: Array  # (L,) mm along the sighting ray, independent from line to line
    sigma_cal: Array  # (L,) mm along the sighting ray, shared through the calibration
    position: Array  # (L,) px across the line
    width: Array  # (L,) px, one sigma of the stripe
    peak: Array  # (L,) grey levels above the background
    reason: Codes  # (L,) a `Reason`
    laser: str

    @classmethod
    def of(cls, found: Triangulated, stripe: Stripe, laser: str) -> Profile:
        """Join a stripe and the points of its lines."""
        reason = np.where(stripe.reason == Reason.RANGED, found.reason, stripe.reason).astype(np.uint8)
        return cls(
            found.points, found.sigma, found.sigma_cal, stripe.position, stripe.width, stripe.peak, reason, laser
        )

    def __len__(self) -> int:
        """Lines of the image."""
        return len(self.reason)

    @property
    def ranged(self) -> int:
        """Lines with a point."""
        return int((self.reason == Reason.RANGED).sum())

    @property
    def rejected(self) -> dict[str, int]:
        """Lines without a point, by reason, the most frequent first."""
        codes, counts = np.unique(self.reason[self.reason != Reason.RANGED], return_counts=True)
        order = np.argsort(-counts, kind="stable")
        return {Reason(int(codes[k])).key: int(counts[k]) for k in order}

    def summary(self) -> Summary:
        """Lines with a point, their noise, and why the others have none."""
        figures = [("sigma", number(float(np.nanmedian(self.sigma)), "mm"))] if self.ranged else []
        figures += [(reason, f"{count} lines") for reason, count in list(self.rejected.items())[:3]]
        return Summary(f"Profile of {self.laser}: {self.ranged} of {len(self)} lines have a point", tuple(figures))

    def picture(self) -> tuple[Picture | None, str]:
        """The profile as a side view: along the stripe to the right, z down."""
        points = self.points[self.reason == Reason.RANGED]
        if len(points) < 2:
            return None, ""
        flat = points[:, :2] - points[:, :2].mean(axis=0)
        along = flat @ np.linalg.svd(flat, full_matrices=False)[2][0]
        return scatter(along, points[:, 2], points[:, 2]), "along the stripe to the right, z down, coloured by z"

"""How a pose is asked for and what the answer says."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from calibration.geometry import Array, Ints, Pose
from calibration.notebook import Picture, Shown, Summary, number, scatter
from scope.model import Model
from scope.pose.residuals import FaceResidual
from scope.pose.uncertainty import Uncertainty
from scope.variants import Undecided, Variant

LEAST_SHOWN = 0.02  # of the part's surface; a sight of less is no basis for a decision


@dataclass(frozen=True, slots=True)
class PoseOptions:
    """How a pose is searched and when it is believed."""

    tolerance: float = 0.05  # mm, one sigma: by how much the part may differ from its mesh, when poses are compared
    form: float = 0.01  # mm, one sigma: no residual is known better than this, when a pose is refined
    starts: int = 800  # orientations tried
    candidates: int = 10  # poses rated against each other
    least_explained: float = 0.75  # share of the points that must lie on the model (a clamp may hide and add some)
    least_covered: float = 0.75  # share of the surface that should have been seen and was
    most_blocked: float = 0.05  # share of the points seen through the model
    several: bool = True  # look for further equal parts
    harder: bool = True  # search again with more starts where the first search leaves a doubt
    part_tolerance: float = 0.1  # mm: surfaces of the right part lie this near to the mesh; 0.1 either side


@dataclass(frozen=True, slots=True, eq=False)
class Candidate:
    """One pose that was rated."""

    cloud_from_model: Pose
    explained: float  # share of the points that lie on the model
    blocked: float  # share of the points seen through the model
    covered: float  # share of the expected surface that was seen, NaN where unknown
    behind: float  # nats by which it is worse than the best


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class PoseResult(Shown):
    """The pose of one part; ``cloud_from_model`` is None where the answer must not be used."""

    cloud_from_model: Pose | None
    covariance: Array | None  # (6, 6) of x, y, z (mm) and turns about x, y, z of the cloud at the model's origin (rad)
    uncertainty: Uncertainty | None
    score: float  # nats to the runner-up, inf without one
    rmse_mm: float  # of the explained points, across the surface
    ambiguous: bool
    why: str  # one sentence: why refused or ambiguous, or what decided
    candidates: tuple[Candidate, ...]  # best first; the first is the answer if there is one
    tell_apart: str  # what would settle it, where ambiguous
    axis: tuple[Array, Array] | None  # point and direction, cloud frame, of a continuous symmetry of the part
    points: Ints  # rows of the cloud that were taken for this part
    deviation: Array  # (len(points),) mm, signed distance from the model at the best candidate
    model: Model
    others: tuple[PoseResult, ...] = ()  # further equal parts in the same scan
    variant: Variant | None = None  # how the scanned part differs from the mesh by more than its tolerance
    undecided: tuple[Undecided, ...] = ()  # variants that would look the same in this scan
    faces: tuple[FaceResidual, ...] = ()  # what the best candidate leaves on each face of the model
    part_tolerance: float = 0.1  # mm, by which they were judged

    @property
    def found(self) -> bool:
        """Whether there is a pose to use."""
        return self.cloud_from_model is not None

    def summary(self) -> Summary:
        """Where the part is and how sure that is, or why it cannot be told."""
        figures = [("points", f"{len(self.points):,}"), ("rms", number(self.rmse_mm, "mm"))]
        if self.cloud_from_model is None:
            return Summary(f"PoseResult, no pose: {self.why}", tuple(figures))
        at = ", ".join(f"{x:.3f}" for x in self.cloud_from_model.translation)
        if self.covariance is not None:
            spread = np.sqrt(np.diag(self.covariance))
            figures.append(("sigma", f"{spread[:3].max():.2g} mm, {np.degrees(spread[3:].max()):.2g} degrees at worst"))
        figures.append(("runner-up", "none" if np.isinf(self.score) else f"{self.score:.3g} nats behind"))
        return Summary(f"PoseResult at ({at}) mm", tuple(figures))

    def picture(self) -> tuple[Picture | None, str]:
        """The part where it was found, seen along z of the cloud."""
        if self.cloud_from_model is None:
            return None, ""
        x, y, z = self.cloud_from_model.apply(self.model.samples).T
        return scatter(x, y, z), "the part's surface where it was found, seen along z of the cloud, coloured by z"

"""The last step of a pose: every point by what ranging states of it, edges as edges, and no few points believed alone.

In: the points of a part with sigma, where camera and laser stood, and a pose within half a millimetre.
Out: `Estimate`: the pose of generalised least squares, with the gain of every point from which its covariance follows.
Read: stripe, footprint, groups, system, estimator.
"""

from scope.refinement.estimator import Estimate, Held, refined
from scope.refinement.stripe import UNKNOWN_WIDTH, Seen, Stripe, motions_of
from scope.refinement.system import Frame

__all__ = ["UNKNOWN_WIDTH", "Estimate", "Frame", "Held", "Seen", "Stripe", "motions_of", "refined"]

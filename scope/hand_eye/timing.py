"""By how much the clock of the images and that of the robot's log differ: one more unknown of hand and eye."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from calibration.errors import CalibrationError
from calibration.geometry import Array
from calibration.stages import HandEyeFit, SeenTarget, Start, consensus, delay_step, solve_hand_eye
from scope.session import HandEyePlan, PoseTrack

_REACH = 0.5  # s, either way, over which a start is sought
_STARTS = 41
_STEPS = 8
_TOLD = 0.05  # s: one sigma beyond which the delay is not determined


@dataclass(frozen=True, slots=True, eq=False)
class Delay:
    """What must be added to an image's time to find its pose in the log."""

    seconds: float
    sigma: float  # s, one standard deviation


def with_delay(
    plan: HandEyePlan, track: PoseTrack, views: list[SeenTarget], seconds: Array, camera: Array | None
) -> tuple[list[SeenTarget], Start, HandEyeFit, Delay]:
    """Views with the poses that fit best, what they agree on, the fit, and the delay with its uncertainty in all.

    Parameters
    ----------
    plan, track : HandEyePlan, PoseTrack
        The log over time.
    views : list of SeenTarget
        Whose poses of the robot are set here.
    seconds : (n,) array
        When each was taken, by the clock of the images.
    camera : (P, P) or None
        Covariance of the camera's parameters.

    Raises
    ------
    CalibrationError
        An arm that stands still at its images, or a log that is too short.
    """
    low, high = float(track.seconds[0] - seconds.min()), float(track.seconds[-1] - seconds.max())
    low, high = max(low, -_REACH), min(high, _REACH)
    if low > high:
        raise CalibrationError(
            f"{track.path.name} covers {track.seconds[0]:.3f} to {track.seconds[-1]:.3f} s, the images {seconds.min():.3f} to {seconds.max():.3f} s: "
            "let the log begin before the first image and end after the last, by the same clock within half a second"
        )
    tried = [
        (consensus(_at(views, track, seconds + d), plan.mount).typical_mm, d) for d in np.linspace(low, high, _STARTS)
    ]
    delay = min(tried)[1]
    sigma = np.inf
    for _ in range(_STEPS):
        seen = _at(views, track, seconds + delay)
        start = consensus(seen, plan.mount)
        fit = solve_hand_eye(seen, plan.mount, repeatability=plan.repeatability, camera_covariance=camera, start=start)
        kept = np.array([v.used for v in fit.views])
        chosen = [v.taken(int(c)) for v, c, k in zip(seen, start.choice, kept, strict=True) if k]
        twists = track.twists((seconds + delay)[kept])
        step, sigma, wider = delay_step(chosen, twists, plan.mount, fit)
        if not sigma < _TOLD:
            raise CalibrationError(
                f"the arm hardly moves while the images are taken, so that the delay stays open by {min(sigma, 99.0):.2g} s (one sigma): take images "
                "while the arm moves, or state delay"
            )
        delay = float(np.clip(delay + step, low, high))
        if abs(step) < 0.02 * sigma:
            break
    return seen, start, replace(fit, covariance=wider + fit.of_camera), Delay(delay, sigma)


def _at(views: list[SeenTarget], track: PoseTrack, seconds: Array) -> list[SeenTarget]:
    return [view.saying(pose) for view, pose in zip(views, track.at(seconds), strict=True)]

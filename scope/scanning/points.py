"""Second stage: stripes to points, each in the cloud frame, as the frame alone tells them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from ranging.robot import Robot
from ranging.surface import MeasuredProfile, Timeframe
from ranging.triangulation import triangulate
from scope.scanning.setup import ScanSetup
from scope.scanning.stripes import FrameStripes


@dataclass(frozen=True, slots=True, eq=False)
class FramePoints:
    """One frame's points, by the index of the laser."""

    number: int
    profiles: dict[int, MeasuredProfile] = field(default_factory=dict)
    timeframes: dict[int, Timeframe] = field(default_factory=dict)


def triangulate_frames(setup: ScanSetup, frames: Sequence[FrameStripes]) -> list[FramePoints]:
    """Meet the sighting rays of frames with the sheets of light: all frames at once, laser by laser."""
    points = [FramePoints(frame.number) for frame in frames]
    for k, laser in enumerate(setup.lasers):
        shown = [(place, each) for place, frame in enumerate(frames) for each in frame.lasers if each.laser == k]
        if not shown:
            continue
        pixels = np.concatenate([each.stripe.pixels for _, each in shown])
        sigma_px = np.concatenate([each.stripe.sigma for _, each in shown])
        across = 1 if laser.along == "rows" else 0
        found = triangulate(setup.rig.camera, laser, pixels, sigma_px, across, extrapolate=setup.options.extrapolate)
        begin = 0
        for place, each in shown:
            frame, stripe = points[place], each.stripe
            end = begin + len(stripe.position)
            pose = setup.motion.cloud_from_c(frame.number)
            part = found.rows(begin, end)
            if isinstance(setup.motion, Robot):
                moved = setup.motion.sigma_along(frame.number, part.points, part.view)
                part = replace(part, sigma_cal=np.hypot(part.sigma_cal, moved))
            frame.profiles[k] = MeasuredProfile.of(part, stripe, pose, setup.centre)
            frame.timeframes[k] = Timeframe(
                each.image, each.dark, laser.along, setup.saturation(each.image), pose,
                part.slide @ pose.rotation.T, stripe.floor,
            )  # fmt: skip
            begin = end
    return points

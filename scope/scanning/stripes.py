"""First stage: a frame to the stripes of the lasers that it shows."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from calibration.errors import ScopeError
from calibration.reason import Reason
from ranging.background import Image, to_gray
from ranging.errors import RangingError
from ranging.stripe import Stripe, extract
from scope.scanning.setup import ScanSetup
from scope.session import Frame

CROSSING = 4.0  # widths (one sigma) of both stripes between their middles, within which they disturb each other


@dataclass(frozen=True, slots=True, eq=False)
class LaserStripe:
    """One laser's stripe on one frame, and the images that show it."""

    laser: int
    stripe: Stripe
    image: Image  # (rows, columns), the laser's channel
    dark: Image | None  # the same with the laser off


@dataclass(frozen=True, slots=True, eq=False)
class FrameStripes:
    """One frame's stripes."""

    number: int
    lasers: tuple[LaserStripe, ...]


def find_stripes(setup: ScanSetup, frame: Frame) -> FrameStripes:
    """Stripes of one frame; frames are independent of each other, so this may run in threads.

    Raises
    ------
    FileError, RangingError
        A frame of another size or type than the others.
    """
    setup.require_alike(frame.image, frame.name)
    count = len(setup.lasers)
    shown = [frame.number % count] if setup.in_turn else range(count)
    found = []
    for k in shown:
        channel, along = setup.channels[k], setup.lasers[k].along
        image = to_gray(frame.image, channel)
        dark = setup.darks[k] if frame.background is None else to_gray(frame.background, channel)
        try:
            stripe = extract(image, along=along, options=setup.stripe, background=dark)  # type: ignore[arg-type]
        except ScopeError as error:
            raise RangingError(f"{frame.name}: {error}") from error
        found.append(LaserStripe(k, stripe, image, dark))
    _uncross([each.stripe for each in found])
    return FrameStripes(frame.number, tuple(found))


def _uncross(found: list[Stripe]) -> None:
    """Strike out the lines on which two stripes cross: there each takes light away from the other."""
    for i, a in enumerate(found):
        for b in found[i + 1 :]:
            if a.along == b.along:
                close = np.abs(a.position - b.position) < CROSSING * (a.width + b.width)
                for stripe in (a, b):
                    stripe.position[close], stripe.reason[close] = np.nan, Reason.TWO_PEAKS

"""The channel in which a laser's stripe is read, by what decides: the error of the stripe on this target."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from calibration.geometry import Array
from ranging.background import Channel, Image, choose_channel
from scope.calibrating.plates import Seen

_COLOURS: tuple[Channel, ...] = ("red", "green", "blue")
_EVERY: tuple[Channel, ...] = (*_COLOURS, "gray", "red-excess", "green-excess", "blue-excess")
_BETTER = 0.9  # of the error of the channel that the colours of the images speak for: less is a reason for another
_SURELY = 0.8  # likewise of the laser's own colour, against the others
_BLOCK = 16  # lines


@dataclass(frozen=True, slots=True)
class Choice:
    """A channel, and what each that was tried promised."""

    channel: Channel
    errors: Mapping[str, float]  # px, of one stripe over all its lines; infinite where there is none


def candidates(
    asked: Channel, images: list[Image], *, several: bool, laser_off: bool
) -> tuple[Channel, tuple[Channel, ...]]:
    """The channel that the images' colours speak for, and those that compete with it.

    A colour that was named competes with its own excess only. Of several lasers none is read in grey, in which they could not be
    told apart when they shine together.
    """
    usual = choose_channel(images, asked, laser_off=laser_off)
    if all(image.ndim == 2 or image.shape[2] < 3 for image in images) or asked == "gray" or asked.endswith("-excess"):
        return usual, (usual,)
    if asked != "auto":
        return usual, (asked, f"{asked}-excess")  # type: ignore[return-value]
    return usual, tuple(channel for channel in _EVERY if channel != "gray" or not several or usual == "gray")


def choose(usual: Channel, found: Mapping[Channel, Sequence[Seen]], guide: Channel = "gray") -> Choice:
    """Take the channel of the least error; the usual one unless another is better by a tenth.

    ``found`` has the stripes of some views in each channel, those on the sheet that the views share: what is no stripe of the
    laser does not count, however bright. ``guide`` is the channel that shows the stripe on the most lines: where it is a
    colour or its excess, that is the laser's, and the other colours, which see it by leakage only, have to be better by more
    than such errors can be predicted to.
    """
    most = max(len(stripes) for stripes in found.values())
    errors: dict[str, float] = {channel: _error(stripes, most) for channel, stripes in found.items()}
    best = min(found, key=lambda channel: errors[channel])
    colour = guide.removesuffix("-excess")
    if colour in _COLOURS:
        own = min((c for c in found if c.removesuffix("-excess") == colour), key=lambda channel: errors[channel])
        if errors[own] * _SURELY <= errors[best]:
            best = own
        if usual.removesuffix("-excess") != colour:
            usual = own
    if not np.isfinite(errors[best]) or errors.get(usual, np.inf) * _BETTER <= errors[best]:
        best = usual
    return Choice(best, errors)


def _error(stripes: Sequence[Seen], views: int) -> float:
    """Error, px, of one of the views' stripes over all its lines: each errs by its sigma and its scatter about the course.

    Lines that have no stripe in a channel, since they are clipped, hidden by the background or lost in noise, are missing
    from the sum.
    """
    information = sum(_information(stripe) for stripe in stripes)
    return float(np.sqrt(views / information)) if information > 0 else float("inf")


def _information(stripe: Seen) -> float:
    """Sum over the lines of a stripe of 1/error^2, px^-2.

    What the pattern of a board or the grain of a surface does to neighbouring lines alike does not average out over them: the
    scatter of the means of blocks of lines tells how much that is.
    """
    across = stripe.flat - stripe.flat.mean(axis=0)
    off = across @ np.linalg.svd(across, full_matrices=False)[2][1] / stripe.scale
    variance = _spread(off) ** 2
    blocks = [block.mean() for block in np.array_split(off, len(off) // _BLOCK)] if len(off) >= 4 * _BLOCK else []
    shared = _BLOCK * _spread(np.array(blocks)) ** 2 if blocks else 0.0
    return float((1.0 / (np.nan_to_num(stripe.sigma, nan=1.0) ** 2 + max(variance, shared) + 1e-6)).sum())


def _spread(values: Array) -> float:
    return 1.4826 * float(np.median(np.abs(values - np.median(values))))

"""The channel of a capture, where the one that the colours speak for shows little of the stripe."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from ranging.background import Channel, Image, to_gray
from ranging.stripe.extraction import Along, StripeOptions, extract

_SMOOTH = 1.5  # px between neighbouring lines of a stripe
_RUN = 8  # lines of one course, from which light counts as a stripe
_NARROW = 6.0  # px, one sigma: in the excess of a colour, what is left of a stripe that is clipped white looks like a wide one
_MORE = 2.0  # times as much of the stripe must another channel show to be taken


def best_channel(
    images: Sequence[Image],
    usual: Channel,
    others: Sequence[Channel],
    *,
    along: Along,
    background: Image | None = None,
    options: StripeOptions | None = None,
) -> Channel:
    """Take another channel than the usual one where it shows twice as much of the stripe.

    A bright stripe on a dim scene is clipped white in its middle, where a colour's excess has a hole: its plain colour, or grey,
    then has all of it. Only lines that go on from neighbour to neighbour count, since single ones may be anything.

    Parameters
    ----------
    images : sequence of images
        A few frames with the laser on.
    usual, others : Channel
        What `choose_channel` says, and what may be better.
    along : "rows" or "columns"
    background : image, optional
        The scene with the laser off.
    options : StripeOptions
        Of the scan.
    """
    if not images or all(image.ndim == 2 or image.shape[2] < 3 for image in images):
        return usual
    seen = {channel: _lines(images, channel, along, background, options) for channel in (usual, *others)}
    best = max(seen, key=lambda channel: seen[channel])
    return best if seen[best] > _MORE * seen[usual] and seen[best] >= _RUN * len(images) else usual


def _lines(
    images: Sequence[Image], channel: Channel, along: Along, background: Image | None, options: StripeOptions | None
) -> int:
    """Number of lines that belong to a run of stripe."""
    dark = None if background is None else to_gray(background, channel)
    options = replace(options or StripeOptions(), maximum_width=_NARROW)
    return sum(
        _in_runs(extract(to_gray(image, channel), along=along, options=options, background=dark).position)
        for image in images
    )


def _in_runs(position: np.typing.NDArray[np.float64]) -> int:
    """Lines (of N) that hang together in runs of `_RUN` or more."""
    joined = np.abs(np.diff(position)) < _SMOOTH  # False where either is NaN
    edges = np.flatnonzero(np.diff(np.concatenate([[False], joined, [False]]).astype(np.int8)))
    lengths = edges[1::2] - edges[::2] + 1
    return int(lengths[lengths >= _RUN].sum())

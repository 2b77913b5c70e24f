"""What the compiled passes hand to each other: a flat image read as lines, and a table of answers, one column a line."""

from __future__ import annotations

from typing import Any, NamedTuple, TypeAlias

import numpy as np
from numpy.typing import NDArray

from calibration.compiled import compiled

# Number of lines, pixels of a line, steps in memory to the next line and to the next pixel: one compilation serves
# stripes along rows and along columns.
Layout: TypeAlias = tuple[int, int, int, int]

_NONE = np.empty(0, np.bool_)


class Lines(NamedTuple):
    """An image as lines across the stripe."""

    pixels: NDArray[Any]  # flat, uint8 or uint16
    dark: NDArray[Any]  # flat, likewise; empty where no laser-off image is subtracted
    layout: Layout
    saturation: float  # level from which a pixel is clipped
    clipped: NDArray[np.bool_] = (
        _NONE  # flat, pixels that hold clipped light although below that level; empty where none can
    )


@compiled
def is_clipped(lines: Lines, at: int) -> bool:
    """Whether the light of a pixel is at least what was recorded, rather than that."""
    return bool(lines.pixels[at] >= lines.saturation or (lines.clipped.size > 0 and lines.clipped[at]))


class CameraNoise(NamedTuple):
    """Photon transfer: a pixel of m grey levels varies by ``variance`` + m / ``gain_e``."""

    gain_e: float  # electrons a grey level
    variance: float  # of a dark pixel, grey levels squared


# Rows of the table: px, px, px, grey levels, grey levels, -, -, -, pixels, a state.
POSITION, SIGMA, WIDTH, PEAK, FLOOR, ASYMMETRY, ASYMMETRY_SIGMA, MISFIT, CLIPPED, STATE = range(10)
ROWS = 10

GOOD = 0  # measured
NO_PEAK = 1  # nowhere to look
NO_FLANK = 2  # as bright as half the peak as far as was looked
CUT = 3  # by the border of the image
DIVERGED = 4  # no stripe of that shape

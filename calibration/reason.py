"""Why a pixel has no point: one list for every stage, so that nothing is ever dropped in silence."""

from __future__ import annotations

from enum import IntEnum

TROUBLES = "docs/troubleshooting.md"  # every reason and every kind of fault stands there under its own word


def see(*words: str) -> str:
    """Where the documentation tells of reasons or kinds of faults; empty for none."""
    return f"{TROUBLES}#{', #'.join(dict.fromkeys(words))}" if words else ""


class Reason(IntEnum):
    """Why a row of a result is NaN; ``RANGED`` is the only one with a point.

    The names, in lower case, are the keys of ``rejected`` in JSON and in reports.
    """

    RANGED = 0
    NO_LIGHT = 1  # no peak stands clear of the noise
    TOO_NARROW = 2  # a hot pixel or a glint, not a stripe
    TOO_WIDE = 3  # a halo, a grazing or a scattered stripe
    SATURATED = 4  # clipped over so much of its width that it has no flanks
    TWO_PEAKS = 5  # two stripes of like strength: which one is real is not known
    EDGE = 6  # half a stripe, at an occlusion or an edge of reflectance
    OUT_OF_VIEW = 7  # cut by the border of the image
    OUTSIDE_CALIBRATION = 8  # the ray was never calibrated there
    SHALLOW = 9  # the ray nearly runs within the sheet of light
    UNCERTAIN = 10  # sigma above the limit that was asked for

    @property
    def key(self) -> str:
        """Name as it stands in JSON."""
        return self.name.lower()

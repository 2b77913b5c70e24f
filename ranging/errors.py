"""Errors of ranging; the whole tree stands in `calibration.errors`."""

from __future__ import annotations

from calibration.errors import ScopeError


class RangingError(ScopeError):
    """Stripes, motion or captures that cannot be ranged."""

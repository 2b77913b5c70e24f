"""Errors of measuring; the whole tree stands in `calibration.errors`."""

from __future__ import annotations

from calibration.errors import ScopeError


class MeasurementError(ScopeError):
    """A cloud from which the wanted result does not follow."""


class MissingLibraryError(ScopeError):
    """An optional Python package or a system library that this work needs and that is not installed."""


class CameraError(ScopeError):
    """A camera that does not answer, breaks off, refuses a setting or gives other images than it should."""

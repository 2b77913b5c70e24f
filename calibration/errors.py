"""Errors that the world causes, as one tree.

ScopeError                  anything a user can put right; the command line prints it and exits with 1
|-- FileError               a file that is missing, unreadable or not what it should be
|-- CalibrationError        images or numbers from which no trustworthy calibration follows
|-- RangingError            (ranging.errors) stripes, motion or captures that cannot be ranged
|-- CameraError             (scope.errors) a camera that does not answer, breaks off or gives other images than it should
|-- MeasurementError        (scope.errors) a cloud from which the wanted result does not follow
`-- MissingLibraryError     (scope.errors) an optional or system library that is not installed

A wrong argument from a caller's own code is a ``ValueError`` and never part of this tree. Every message is one line
that says what was found, what was needed and what to do.
"""

from __future__ import annotations


class ScopeError(Exception):
    """Bad data, with a message of one line: what was found, what was needed, what to do."""


class FileError(ScopeError):
    """A file that is missing, unreadable, or holds something other than it should."""


class CalibrationError(ScopeError):
    """Images or numbers from which no trustworthy calibration follows."""

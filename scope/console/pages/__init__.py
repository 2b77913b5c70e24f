"""The pages of the console, by NiceGUI.

In: a `Console`.
Out: pages at /, /calibrate, /scan, /measure and /history.
Read: layout, live, calibrate, scan, measure, history.
"""

from scope.console.pages.calibrate import add_calibrate
from scope.console.pages.history import add_history
from scope.console.pages.live import add_live
from scope.console.pages.measure import add_measure
from scope.console.pages.scan import add_scan

__all__ = ["add_calibrate", "add_history", "add_live", "add_measure", "add_scan"]

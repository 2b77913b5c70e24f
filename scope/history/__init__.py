"""What was calibrated, verified, scanned and checked over time: records, control charts, and when to calibrate again.

In: results of commands and of the console.
Out: an SQLite file beside the results, its records as tables, and limits and trends of their figures.
Read: journal, figures, chart.
"""

from scope.history.chart import Chart, chart_of
from scope.history.figures import calibration_figures, check_figures, scan_figures, verification_figures
from scope.history.journal import Journal, Record, journal_beside, records_csv

__all__ = [
    "Chart",
    "Journal",
    "Record",
    "calibration_figures",
    "chart_of",
    "check_figures",
    "journal_beside",
    "records_csv",
    "scan_figures",
    "verification_figures",
]

"""The scan as a line of stages: frames, stripes, points, refined points, a cloud.

In: a rig, and a capture or frames in memory with their motion.
Out: `ScanCloud` and what the scan tells of itself: lines with a point, reasons of the others, lasers that
    disagree.
Read: run, options, setup, preparation, table, stripes, points, refinement, assembly, statistics, file, scanner,
    covariance, agreement, overlap.
"""

from scope.scanning.agreement import Agreement
from scope.scanning.covariance import boxes_of, point_covariance, systematic_of
from scope.scanning.file import scan_to_file
from scope.scanning.options import ScanOptions
from scope.scanning.run import gathered, open_scan, run_scan, scan
from scope.scanning.scanner import Scanner
from scope.scanning.statistics import Chunk, Scan
from scope.scanning.table import Table, table_motion

__all__ = [
    "Agreement",
    "Chunk",
    "gathered",
    "open_scan",
    "Scan",
    "ScanOptions",
    "Scanner",
    "boxes_of",
    "Table",
    "point_covariance",
    "run_scan",
    "scan",
    "scan_to_file",
    "systematic_of",
    "table_motion",
]

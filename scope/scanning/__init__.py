"""scope.scanning."""

from scope.scanning.agreement import Agreement
from scope.scanning.covariance import point_covariance
from scope.scanning.file import scan_to_file
from scope.scanning.options import ScanOptions
from scope.scanning.run import run_scan, scan
from scope.scanning.statistics import Scan

__all__ = ["Agreement", "Scan", "ScanOptions", "point_covariance", "run_scan", "scan", "scan_to_file"]

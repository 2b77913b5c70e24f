"""A cloud for the programs of others: each scalar under the name and in the order that the reader takes.

In: a `ScanCloud` and the name of a program: cloudcompare, meshlab, open3d, pcl, pyvista or ros2.
Out: a file that this program reads whole, and one line on what it cannot hold.
    Points with deviations or heights: the same rules.
Read: programs, vtp, ros2, scalars.
"""

from scope.export.programs import PROGRAMS, Program, export_for, lost_by, program_for, require_program
from scope.export.scalars import require_scalars, write_scalars

__all__ = [
    "PROGRAMS",
    "Program",
    "export_for",
    "lost_by",
    "program_for",
    "require_program",
    "require_scalars",
    "write_scalars",
]

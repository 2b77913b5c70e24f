"""The cloud that everything measures: its columns, its lattice, regions, filters, and every file format.

In: points in scan order with what is known of each; or a file of another program.
Out: `ScanCloud`, and PLY, PCD, XYZ, LAS, E57 files.
Read: columns, scan_cloud, lattice, normals, sheet, region, region_text, near_mesh, filters, files, fields, ply,
    pcd, text, surveying.
"""

from scope.cloud.columns import Sensors, Systematic
from scope.cloud.fields import MOST_ERRORS, SENSOR, VERTEX
from scope.cloud.files import (
    READ,
    comments,
    not_carried,
    other_scalars,
    require_format,
    sensor_records,
    systematic_records,
    told,
    unknown,
    vertex_records,
)
from scope.cloud.filters import FilterOptions, filtered
from scope.cloud.lattice import lattice_index, lattice_lines
from scope.cloud.near_mesh import NEAR, Mesh, read_mesh
from scope.cloud.normals import lattice_normals, lattice_spacing
from scope.cloud.region import Box, Polygon, Region
from scope.cloud.region_text import parse_region, require_names
from scope.cloud.scan_cloud import ScanCloud
from scope.cloud.sheet import refuse_sheet

__all__ = [
    "Box",
    "FilterOptions",
    "MOST_ERRORS",
    "Mesh",
    "NEAR",
    "Polygon",
    "READ",
    "Region",
    "SENSOR",
    "ScanCloud",
    "Sensors",
    "Systematic",
    "VERTEX",
    "comments",
    "filtered",
    "lattice_index",
    "lattice_lines",
    "lattice_normals",
    "lattice_spacing",
    "not_carried",
    "other_scalars",
    "parse_region",
    "read_mesh",
    "refuse_sheet",
    "require_format",
    "require_names",
    "sensor_records",
    "systematic_records",
    "told",
    "unknown",
    "vertex_records",
]

"""The cloud that everything measures: its columns, read from and written to files."""

from __future__ import annotations

from dataclasses import dataclass, fields
from pathlib import Path
from typing import Self

from scope.cloud.columns import Columns
from scope.cloud.files import read_cloud, write_cloud


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class ScanCloud(Columns):
    """N ranged points of one scan, in scan order: by frame, then along the stripe.

    The frame is that of the calibration (C) with the object put back to position 0. ``sigma`` is independent from
    point to point and averages out; ``sigma_cal`` comes from the calibration, is shared, and does not. The columns and
    their units stand in `scope.cloud.columns`.
    """

    @classmethod
    def load(cls, path: str | Path) -> Self:
        """Read a cloud from a file that `save` wrote, or of any maker: PLY, PCD, XYZ, LAS, LAZ, E57."""
        columns = read_cloud(Path(path))
        return cls(**{each.name: getattr(columns, each.name) for each in fields(Columns)})

    def save(self, path: str | Path) -> None:
        """Write the cloud; the ending of the name chooses the format (see `scope.cloud.files`)."""
        write_cloud(Path(path), self)

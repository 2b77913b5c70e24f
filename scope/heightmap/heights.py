"""Heights on a lattice, with gaps."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from calibration.geometry import Array, Bools
from calibration.notebook import Picture, Shown, Summary, coloured, enlarged


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class HeightMap(Shown):
    """Heights above a reference on a lattice of rows and columns; NaN where nothing was measured.

    For a scan, rows are profiles (frames) and columns positions along the stripe. Positive is out of the material,
    towards the sensor.
    """

    z: Array  # (rows, columns) mm, NaN in gaps
    pitch: tuple[float, float]  # mm between rows, mm between columns
    sigma: Array | None = None  # (rows, columns) mm, independent noise of each height, one standard deviation
    points: Array | None = None  # (rows, columns, 3) mm, where each height was measured, in the cloud frame
    origin: tuple[int, int] = (0, 0)  # frame and image line of the first row and column, for a scan
    stripe_width: float = float("nan")  # mm, one sigma of the stripe on the surface, down the rows; NaN: not known
    stripe_corrected: float = 0.0  # share (0 to 1) of what that width does to heights that ranging took off
    in_order: bool = True  # the lattice is that on which the surface was sampled
    form: str = "none"  # what the F-operator removed
    filters: tuple[str, ...] = ()  # what was filtered, in order
    notes: tuple[str, ...] = ()  # what a reader must know of how the map came about

    def summary(self) -> Summary:
        """Size, pitch, gaps and form."""
        rows, columns = self.z.shape
        pitch = f"{self.pitch[0]:.3g} x {self.pitch[1]:.3g} mm"
        return Summary(
            f"HeightMap of {rows} x {columns} heights",
            (("pitch", pitch), ("gaps", f"{100 * self.gap_share:.1f} %"), ("form removed", self.form)),
        )

    def picture(self) -> tuple[Picture | None, str]:
        """The heights, coloured."""
        return enlarged(coloured(self.z)), "heights, a row a profile; gaps are grey"

    def __post_init__(self) -> None:
        if self.z.ndim != 2 or not all(np.isfinite(p) and p > 0.0 for p in self.pitch):
            raise ValueError("a height map is (rows, columns) with a positive pitch in both directions")
        if self.sigma is not None and self.sigma.shape != self.z.shape:
            raise ValueError("sigma must have the shape of the heights")
        if self.points is not None and self.points.shape != (*self.z.shape, 3):
            raise ValueError("points must be (rows, columns, 3)")

    @property
    def known(self) -> Bools:
        """Mask (rows, columns) of the heights that were measured."""
        return np.isfinite(self.z)

    @property
    def size(self) -> tuple[float, float]:
        """Extent (down, along), mm."""
        return (self.z.shape[0] - 1) * self.pitch[0], (self.z.shape[1] - 1) * self.pitch[1]

    @property
    def gap_share(self) -> float:
        """Share (0 to 1) of the lattice on which nothing was measured."""
        return 1.0 - float(self.known.mean()) if self.z.size else 1.0

    @property
    def noise(self) -> float:
        """Predicted noise of the heights: rms of sigma over the known ones, mm; NaN where sigma is not known."""
        if self.sigma is None:
            return float("nan")
        known = self.known & np.isfinite(self.sigma)
        if known.sum() < 0.5 * self.known.sum():
            return float("nan")
        return float(np.sqrt(np.mean(self.sigma[known] ** 2)))

    def places(self) -> tuple[Array, Array]:
        """Position down and along (rows, columns) mm of each lattice point, from the middle of the map."""
        down = (np.arange(self.z.shape[0]) - (self.z.shape[0] - 1) / 2.0) * self.pitch[0]
        along = (np.arange(self.z.shape[1]) - (self.z.shape[1] - 1) / 2.0) * self.pitch[1]
        first, second = np.meshgrid(down, along, indexing="ij")
        return first, second

    def with_heights(self, z: Array, **changes: object) -> HeightMap:
        """Return the map with other heights (rows, columns) mm."""
        return replace(self, z=z, **changes)  # type: ignore[arg-type]

    def cropped(self) -> HeightMap:
        """Return the map without the outer rows and columns that hold no height."""
        known = self.known
        if not known.any():
            return self
        rows, columns = np.flatnonzero(known.any(axis=1)), np.flatnonzero(known.any(axis=0))
        part = np.s_[rows[0] : rows[-1] + 1, columns[0] : columns[-1] + 1]
        return replace(
            self,
            z=self.z[part],
            origin=(self.origin[0] + int(rows[0]), self.origin[1] + int(columns[0])),
            sigma=None if self.sigma is None else self.sigma[part],
            points=None if self.points is None else self.points[part],
        )

"""What a lens, an aperture and a Gaussian beam make of a design in millimetres, milliwatts and nanometres.

Sources: thin lens and blur circle: E. Hecht, Optics, 5.2; the Gaussian that stands for an Airy disk: B. Zhang, J. Zerubia and
J.-C. Olivo-Marin, Applied Optics 46 (2007) 1819 (0.42 lambda N in the image of a far point); image irradiance: B. Horn,
Robot Vision (1986), 10.3; Gaussian beam: A. Siegman, Lasers (1986), 17.1; speckle: J. Goodman, Speckle Phenomena in
Optics (2007), 4.2 (contrast 1 / sqrt(M) of M cells that a pixel averages).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from calibration.geometry import Array

_PLANCK_LIGHT = 6.62607015e-34 * 2.99792458e8  # J m


@dataclass(frozen=True, slots=True)
class Lens:
    """A thin lens before a sensor that may be tilted; its pinhole is the origin of C."""

    focal: float  # mm
    f_number: float
    focus: float  # mm along z, from the lens to what is sharp on the axis
    pixel: float  # mm
    wavelength: float  # mm, for diffraction
    tilt: tuple[float, float] = (0.0, 0.0)  # rad, of the sensor about x and y
    own: float = 0.0  # px, blur of the lens itself, one sigma

    @property
    def image_distance(self) -> float:
        """Distance, mm, from lens to sensor on the axis: f s / (s - f)."""
        return self.focal * self.focus / (self.focus - self.focal)

    @property
    def working_f_number(self) -> float:
        """f-number times 1 + magnification."""
        return self.f_number * self.image_distance / self.focal

    def sensor_distance(self, points: Array) -> Array:
        """Distance (N,) mm along z from the lens to where the sensor sees points (N, 3): it varies where it is tilted."""
        slope = (points[:, 0] * np.tan(self.tilt[1]) + points[:, 1] * np.tan(self.tilt[0])) / points[:, 2]
        return np.asarray(self.image_distance / (1.0 - slope))

    def blur(self, points: Array) -> Array:
        """Blur (N,) px of points (N, 3), one sigma: lens, diffraction and defocus in quadrature.

        The blur circle of diameter c = (f / N) |v - v_z| / v_z is taken for a Gaussian of its own variance, c / 4 an axis: true
        for positions and widths, not for the tails.
        """
        depth = np.maximum(points[:, 2], 1.001 * self.focal)
        sharp = self.focal * depth / (depth - self.focal)
        circle = self.focal / self.f_number * np.abs(self.sensor_distance(points) - sharp) / sharp
        airy = 0.42 * self.wavelength * self.working_f_number
        return np.asarray(np.sqrt(self.own**2 + (airy / self.pixel) ** 2 + (circle / 4.0 / self.pixel) ** 2))

    def in_focus(self, normal: Array, offset: float) -> tuple[float, tuple[float, float]] | None:
        """Focus, mm, and tilt of the sensor, rad, that put the plane normal . x = offset in focus; None where none does.

        With 1 / z = 1 / f - 1 / v the plane's image is v = (offset + n_x x + n_y y) / (offset / f - n_z): a plane
        (Scheimpflug).
        """
        scale = offset / self.focal - normal[2]
        if abs(scale) < 1e-9:
            return None
        distance = offset / scale
        if not distance > 1.001 * self.focal:
            return None
        tilt = (float(np.arctan(normal[1] / scale)), float(np.arctan(normal[0] / scale)))
        return float(self.focal * distance / (distance - self.focal)), tilt

    def speckle(self, wavelength: float) -> tuple[float, float]:
        """Contrast after a pixel's averaging, and grain in px (full width at half height), of polarised speckle."""
        size = wavelength * self.working_f_number / self.pixel  # px
        cells = 1.0 + 1.0 / (4.0 / np.pi * size**2)
        return float(1.0 / np.sqrt(cells)), float(max(1.03 * size, 1.0))

    def levels(self, irradiance: float, wavelength: float, exposure: float, efficiency: float) -> float:
        """Electrons a pixel for white paper under ``irradiance`` (W/mm^2), for an exposure in s."""
        radiance = irradiance / np.pi
        on_sensor = np.pi / 4.0 * radiance / self.working_f_number**2  # W/mm^2
        photons = on_sensor * self.pixel**2 * exposure * wavelength * 1e-3 / _PLANCK_LIGHT
        return float(photons * efficiency)


@dataclass(frozen=True, slots=True)
class Beam:
    """Width of a Gaussian beam across the sheet, and how its light thins out along the fan."""

    waist: float  # mm, one sigma (half of the 1/e^2 radius) where it is narrowest
    at: float  # mm from the laser to the waist
    divergence: float  # rad, one sigma, far from the waist
    dims: bool = False  # whether light falls as 1 / (range width), as it must where its power is known
    reference: float = 0.0  # mm from the laser to where its strength is one

    @classmethod
    def diffracted(cls, waist: float, at: float, wavelength: float) -> Beam:
        """Beam limited by diffraction: sigma diverges by lambda / (4 pi sigma)."""
        return cls(waist, at, wavelength / (4.0 * np.pi * waist))

    def width(self, distance: Array) -> Array:
        """One sigma (N,) mm at distances (N,) mm from the laser."""
        return np.hypot(self.waist, self.divergence * (distance - self.at))

    def strength(self, distance: Array) -> Array:
        """Light (N,) in the middle of the sheet, of that at ``reference``."""
        if not self.dims:
            return np.ones(len(distance))
        there = self.reference * self.width(np.array([self.reference]))[0]
        return np.asarray(there / np.maximum(distance * self.width(distance), 1e-9))

    def irradiance(self, power: float, distance: float, fan: float) -> float:
        """Peak W/mm^2 at a distance for a fan of full angle ``fan`` rad, even along it."""
        width = float(self.width(np.array([distance]))[0])
        return float(power / (2.0 * distance * np.tan(fan / 2.0) * np.sqrt(2.0 * np.pi) * width))

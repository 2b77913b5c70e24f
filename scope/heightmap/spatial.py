"""Autocorrelation, power spectrum and the spatial parameters of a map of heights (ISO 25178-2, clause 4.3)."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from calibration.geometry import Array

DECAY = 0.2  # the correlation at which heights count as unrelated (ISO 25178-3)
ISOTROPIC = 0.6  # Str above this: the texture has no direction worth a name
_LEAST_OVERLAP = 0.05  # of the area: lags with less are not estimated


@dataclass(frozen=True, slots=True, eq=False)
class Autocorrelation:
    """Covariance of heights at every lag, each over the pairs that it really has."""

    covariance: Array  # (2 a + 1, 2 b + 1) mm2, lag (0, 0) in the middle; NaN where too few pairs are
    pitch: tuple[float, float]  # mm (down, along)
    whole: bool  # the lags go as far as the map lets them
    variance: float  # mm2, of the surface alone: the height of the peak once noise is out

    @property
    def centre(self) -> tuple[int, int]:
        """Row and column of lag (0, 0)."""
        return self.covariance.shape[0] // 2, self.covariance.shape[1] // 2

    def reach_beyond(self, open_: tuple[bool, bool], shape: tuple[int, ...]) -> tuple[int, int]:
        """Lags (down, along) that go to the end of a map (rows, columns) where the contour is open."""
        down, along = (n - 1 if free else lag for n, lag, free in zip(shape, self.centre, open_, strict=True))
        return down, along

    def profile(self, axis: int) -> tuple[Array, Array]:
        """Lags (mm) from 0 down (0) or along (1) the map, and the correlation there."""
        i, j = self.centre
        values = self.covariance[i:, j] if axis == 0 else self.covariance[i, j:]
        return np.arange(len(values), dtype=np.float64) * self.pitch[axis], values / self.variance


def autocorrelation(
    first: Array,
    pitch: tuple[float, float],
    *,
    second: Array | None = None,
    noise_variance: float = 0.0,
    reach: tuple[int, int] | None = None,
) -> Autocorrelation:
    """Autocovariance of heights (rows, columns) mm with gaps, or the covariance of two maps of one surface.

    Gaps count as absent, not as zero: at each lag the sum of products is divided by the number of pairs (filling with
    zeros and dividing by N instead shortens Sal by 4 to 7 %). Independent noise stands in lag 0 alone, so that
    ``noise_variance`` (mm2) is taken from there; the product of two scans has none.

    Parameters
    ----------
    first, second : (rows, columns) array, mm
        NaN is a gap. ``second``, if given, is on the same lattice.
    pitch : (down, along), mm
    noise_variance : float
        Variance (mm2) of noise that is independent from height to height.
    reach : (down, along), samples
        Farthest lag; a quarter of the map unless told.

    Raises
    ------
    ValueError
        A map without heights.
    """
    from scipy import fft

    rows, columns = first.shape
    lag = (
        (max(1, rows // 4), max(1, columns // 4))
        if reach is None
        else (min(reach[0], rows - 1), min(reach[1], columns - 1))
    )
    size = tuple(fft.next_fast_len(n + k, real=True) for n, k in zip(first.shape, lag, strict=True))
    a, known_a = _centred(first)
    spectrum = fft.rfft2(a, s=size)
    if second is None:
        product = spectrum.real**2 + spectrum.imag**2
    else:
        b, known_b = _centred(second)
        other = fft.rfft2(b, s=size)
        product = spectrum.real * other.real + spectrum.imag * other.imag  # the mean of both orders: even in the lag
    total = _lags(fft.irfft2(product, s=size), lag)
    if known_a is None and (second is None or known_b is None):
        pairs = np.outer(
            rows - np.abs(np.arange(-lag[0], lag[0] + 1)), columns - np.abs(np.arange(-lag[1], lag[1] + 1))
        )
    else:
        mask = _mask(known_a, first.shape)
        shape = fft.rfft2(mask, s=size)
        if second is None:
            overlap = shape.real**2 + shape.imag**2
        else:
            other = fft.rfft2(_mask(known_b, first.shape), s=size)
            overlap = shape.real * other.real + shape.imag * other.imag
        pairs = np.rint(_lags(fft.irfft2(overlap, s=size), lag))
    enough = pairs >= max(1.0, _LEAST_OVERLAP * float(pairs[lag]))
    covariance = np.divide(total, pairs, out=np.full(total.shape, np.nan), where=enough)
    whole = lag == (rows - 1, columns - 1)
    return Autocorrelation(covariance, pitch, whole, float(covariance[lag]) - noise_variance)


@dataclass(frozen=True, slots=True)
class Decay:
    """How far the autocorrelation reaches before it falls to 0.2."""

    shortest: float  # mm: Sal; NaN where the correlation falls nowhere within the map
    longest: float  # mm, in the slowest direction; a lower bound unless closed
    open: tuple[bool, bool]  # the contour runs off the lags down, along

    @property
    def closed(self) -> bool:
        """Whether the contour closes within the map."""
        return not any(self.open)


def decay(acf: Autocorrelation, *, level: float = DECAY) -> Decay:
    """Nearest and farthest point of the contour, about lag 0, where the correlation is ``level``.

    The contour is crossed where lattice lines leave the region about lag 0, by cubic interpolation. A ridge that
    stays correlated over the whole map leaves the contour open: ``longest`` is then what was seen of it. Nothing
    follows (NaN, open) where the variance is not positive.
    """
    if not acf.variance > 0.0:
        return Decay(float("nan"), float("nan"), (True, True))
    correlation = acf.covariance / acf.variance
    i0, j0 = acf.centre
    correlation[i0, j0] = 1.0
    padded = np.pad(correlation, 2, constant_values=np.nan)
    inside = padded > level
    _, labels = cv2.connectedComponents(inside.astype(np.uint8), connectivity=4)
    region = labels == labels[i0 + 2, j0 + 2]
    near, far, unbounded = np.inf, 0.0, [False, False]
    for step in ((0, 1), (0, -1), (1, 0), (-1, 0)):
        outside = ~np.roll(region, (-step[0], -step[1]), axis=(0, 1))
        rows, columns = np.nonzero(region & outside)
        four = np.stack([padded[rows + k * step[0], columns + k * step[1]] for k in (-1, 0, 1, 2)])
        unknown = np.isnan(four[2])
        unbounded[0 if step[0] else 1] |= bool(unknown.any())
        part = np.where(unknown, 0.0, _crossing(four, level))
        down = (rows - 2 - i0 + part * step[0]) * acf.pitch[0]
        along = (columns - 2 - j0 + part * step[1]) * acf.pitch[1]
        distance = np.hypot(down, along)
        near = min(near, float(distance[~unknown].min(initial=np.inf)))
        far = max(far, float(distance.max(initial=0.0)))
    return Decay(near if np.isfinite(near) else float("nan"), far, (unbounded[0], unbounded[1]))


def _crossing(four: Array, level: float) -> Array:
    """Where (0 to 1) between the middle two of four values (4, N) the cubic through them falls to ``level``.

    Newton's steps from the linear answer, which is kept where an outer value is missing.
    """
    before, here, there, after = four
    part = (here - level) / np.where(here > there, here - there, np.nan)
    start = part.copy()
    second, third = 0.5 * (before - 2.0 * here + there), (after - before) / 6.0 + 0.5 * (here - there)
    first = there - here - second - third
    for _ in range(4):
        value = ((third * part + second) * part + first) * part + here - level
        slope = (3.0 * third * part + 2.0 * second) * part + first
        part = np.clip(part - value / np.where(slope < 0.0, slope, np.nan), 0.0, 1.0)
    return np.asarray(np.where(np.isfinite(part), part, start))


@dataclass(frozen=True, slots=True, eq=False)
class Texture:
    """The spatial parameters and what they were read from."""

    Sal: float  # mm
    Str: float  # NaN where the contour is open
    Std: float  # degrees, NaN on isotropic surfaces
    bound: float  # an upper bound on Str where it is NaN
    acf: Autocorrelation


def texture(
    first: Array, pitch: tuple[float, float], *, second: Array | None = None, noise_variance: float = 0.0
) -> Texture:
    """Sal (mm), Str and Std (degrees) of heights (rows, columns) mm (ISO 25178-2, clause 4.3).

    Lags reach a quarter of the map, and all of it along the axis on which that leaves the contour open. Std is NaN where Str is above
    0.6: an isotropic surface has no direction.
    See `autocorrelation` for the arguments.
    """
    acf = autocorrelation(first, pitch, second=second, noise_variance=noise_variance)
    found = decay(acf)
    while not found.closed and not acf.whole and acf.variance > 0.0:
        reach = acf.reach_beyond(found.open, first.shape)
        if reach == acf.centre:
            break
        acf = autocorrelation(first, pitch, second=second, noise_variance=noise_variance, reach=reach)
        found = decay(acf)
    ratio = found.shortest / found.longest if found.longest > 0.0 else float("nan")
    directed = np.isfinite(ratio) and ratio < ISOTROPIC
    return Texture(
        Sal=found.shortest,
        Str=ratio if found.closed else float("nan"),
        Std=direction(acf) if directed else float("nan"),
        bound=ratio,
        acf=acf,
    )


def power_spectrum(acf: Autocorrelation) -> tuple[Array, Array, Array]:
    """Power spectral density (mm4) and its frequencies down and along (1/mm), zero in the middle.

    The Fourier transform of the autocovariance under a Hann taper (Blackman and Tukey 1958), which gaps do not
    disturb; its resolution is one over the reach of the lags. Estimates below zero are noise and are returned as 0.
    """
    from scipy import fft

    rows, columns = acf.covariance.shape
    taper = np.outer(np.hanning(rows + 2)[1:-1], np.hanning(columns + 2)[1:-1])
    windowed = np.where(np.isfinite(acf.covariance), acf.covariance, 0.0) * taper
    windowed[acf.centre] = acf.variance
    density = fft.fftshift(fft.fft2(fft.ifftshift(windowed)).real) * (acf.pitch[0] * acf.pitch[1])
    down = fft.fftshift(fft.fftfreq(rows, acf.pitch[0]))
    along = fft.fftshift(fft.fftfreq(columns, acf.pitch[1]))
    return np.maximum(density, 0.0), down, along


def angular_density(acf: Autocorrelation, *, step: float = 0.5) -> tuple[Array, Array]:
    """Angle (degrees, 0 to 180) and power of the spectrum summed along that direction of the frequency plane.

    Up to the Nyquist frequency of the coarser pitch and from twice the lowest resolved frequency.
    """
    density, down, along = power_spectrum(acf)
    angle = np.arange(0.0, 180.0, step)
    low, high = 2.0 * max(down[1] - down[0], along[1] - along[0]), min(-down[0], -along[0])
    radius = np.linspace(low, max(high, low), 256)
    heading = np.radians(angle)[:, None]
    u = radius * np.cos(heading) / (along[1] - along[0]) + len(along) // 2
    v = -radius * np.sin(heading) / (down[1] - down[0]) + len(down) // 2
    sampled = cv2.remap(
        density.astype(np.float32), u.astype(np.float32), v.astype(np.float32), cv2.INTER_LINEAR, borderValue=0.0
    )
    return angle, np.asarray((sampled * radius).sum(axis=1), dtype=np.float64)


def direction(acf: Autocorrelation) -> float:
    """Std: the angle (degrees, 0 to 180) at which the angular spectrum is greatest (ISO 25178-2, clause 4.3.4).

    Counter-clockwise from the direction of a row, with the first row on top. Grooves run across it: the lay is
    Std + 90. The peak is refined by the circular mean of the power within 15 degrees of it.
    """
    angle, power = angular_density(acf)
    peak = angle[int(np.argmax(power))]
    near = np.abs((angle - peak + 90.0) % 180.0 - 90.0) <= 15.0
    mean = (power * np.exp(2j * np.radians(angle)))[near].sum()
    return float(np.degrees(np.angle(mean)) / 2.0) % 180.0


def _centred(z: Array) -> tuple[Array, Array | None]:
    """Heights about their mean with gaps at zero, and the mask of known ones: None where nothing is missing."""
    mean = float(z.mean())
    if np.isfinite(mean):
        return z - mean, None
    known = np.isfinite(z)
    if not known.any():
        raise ValueError("the map has no heights")
    return np.where(known, z - float(z[known].mean()), 0.0), known.astype(np.float64)


def _mask(known: Array | None, shape: tuple[int, ...]) -> Array:
    return np.ones(shape) if known is None else known


def _lags(circular: Array, lag: tuple[int, int]) -> Array:
    """Lags from -lag to lag of a circular correlation whose lag 0 stands in its corner."""
    rows = np.arange(-lag[0], lag[0] + 1)
    columns = np.arange(-lag[1], lag[1] + 1)
    return np.asarray(circular[np.ix_(rows, columns)])

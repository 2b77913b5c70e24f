"""Stripes on sloping and curved surfaces: against exact geometry, and against fits to exact profiles."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.optimize import least_squares
from scipy.special import ndtr

from calibration.reason import Reason
from ranging.surface import CONTEXT, Lattice, refine, slope
from ranging.surface import patches as surface
from ranging.surface.course import follow

FOCAL = 1000.0  # px
NORMAL = np.array([0.0, 0.92, -np.sqrt(1.0 - 0.92**2)])  # of the sheet of light
OFFSET = NORMAL @ [0.0, 0.0, 400.0]
CENTRE, RADIUS = np.array([2.0, 0.0, 419.0]), 20.0  # of a sphere, mm
SOURCE = np.array([0.0, -170.0, 1.0])
STEP = 0.4  # mm a frame


def on_sheet(u: np.ndarray, along: np.ndarray) -> np.ndarray:
    """Points (..., 3) in C where the sheet meets the sphere, moved by ``along`` mm in y, on lines u (px)."""
    # a point of line u and of the sheet is z (x, p, 1) + (0, q, 0)
    x, p, q = u / FOCAL, -NORMAL[2] / NORMAL[1], OFFSET / NORMAL[1]
    shift = q - CENTRE[1] - along
    a = x**2 + p**2 + 1.0
    b = -2.0 * (x * CENTRE[0] - p * shift + CENTRE[2])
    c = CENTRE[0] ** 2 + shift**2 + CENTRE[2] ** 2 - RADIUS**2
    z = (-b - np.sqrt(b * b - 4.0 * a * c)) / (2.0 * a)
    return np.stack([x * z, p * z + q, z], axis=-1)


def on_sphere(u: np.ndarray, v: np.ndarray, along: np.ndarray) -> np.ndarray:
    """Points (..., 3) in C where rays of pixels meet the sphere."""
    ray = np.stack([u / FOCAL, v / FOCAL, np.ones_like(v)], axis=-1)
    centre = CENTRE + np.stack([0.0 * along, along, 0.0 * along], axis=-1)
    a, b = (ray**2).sum(axis=-1), (ray * centre).sum(axis=-1)
    c = (centre**2).sum(axis=-1) - RADIUS**2
    return ray * ((b - np.sqrt(b * b - a * c)) / a)[..., None]


def leaving(u: np.ndarray, v: np.ndarray, along: np.ndarray) -> np.ndarray:
    """Distance from the sheet, mm, of what pixels see."""
    return on_sphere(u, v, along) @ NORMAL - OFFSET


def radiance(u: np.ndarray, v: np.ndarray, along: np.ndarray) -> np.ndarray:
    point = on_sphere(u, v, along)
    normal = point - CENTRE - np.stack([0.0 * along, along, 0.0 * along], axis=-1)
    light = SOURCE - point
    return (normal * light).sum(axis=-1) / np.linalg.norm(normal, axis=-1) / np.linalg.norm(light, axis=-1)


def grids(frames: int = 23, lines: int = 41, start: float = 0.0) -> tuple[np.ndarray, np.ndarray]:
    along = start + (np.arange(frames) - frames // 2)[:, None] * STEP + np.zeros(lines)
    u = np.arange(lines)[None, :] - lines // 2 + np.zeros((frames, 1))
    return u, along


def sphere(
    noise: np.ndarray | float = 0.0, *, start: float = 0.0, blur: float = 0.44, width: float = 0.3
) -> tuple[Lattice, np.ndarray]:
    """A scanned sphere; ``noise`` px on its positions, and the displacement that is left out of them, NaN here."""
    u, along = grids(start=start)
    exact = on_sheet(u, along)
    v = FOCAL * exact[..., 1] / exact[..., 2]
    h = 0.05
    a = (leaving(u, v + h, along) - leaving(u, v - h, along)) / (2 * h)
    spread = np.hypot(width / np.abs(a), np.sqrt(blur))
    light = 120.0 * radiance(u, v, along) / np.abs(a)
    moved = np.zeros_like(exact)
    moved[..., 1] = exact[..., 2] / FOCAL
    view = exact / np.linalg.norm(exact, axis=-1, keepdims=True)
    per_px = (moved @ NORMAL) / (view @ NORMAL)
    points = exact + (np.asarray(noise) + 0.0 * v)[..., None] * (moved - per_px[..., None] * view)
    points[..., 1] -= along
    camera = np.zeros((len(u), 3))
    camera[:, 1] = -along[:, 0]
    flat = np.full(u.shape, 0.01)
    lattice = Lattice(
        points=points, view=view, moved=moved, sheet=np.broadcast_to(NORMAL, points.shape), camera=camera,
        sigma=flat * np.abs(per_px), sigma_cal=0.0 * flat, reason=np.zeros(u.shape, np.uint8), position=v + noise,
        sigma_px=flat, width=spread, peak=light / spread, asymmetry=0.0 * flat,
        noise=np.tile([35.0, 1.5, 0.0], (len(u), 1)),
    )  # fmt: skip
    return lattice, a


def scan_of(lattice: Lattice, light: np.ndarray) -> surface.Surface:
    return surface.Surface(
        lattice.points, lattice.view, lattice.moved, lattice.sheet, lattice.camera, lattice.sigma, light
    )


def test_a_sphere_leaves_the_sheet_bends_and_shades_as_its_geometry_says():
    lattice, a = sphere()
    u, along = grids()
    patches = np.full((*u.shape, surface.PATCH), np.nan)
    table = np.full((*u.shape, surface.COLUMNS), np.nan)
    light = np.log(lattice.peak * lattice.width)
    frames = len(u)
    kept = surface.Patches((1, 2), patches, np.zeros(u.shape, bool))
    surface.fit_patches(scan_of(lattice, light), kept, 0, frames, 1.0, table)
    v, h = lattice.position, 0.05
    b = (leaving(u, v + h, along) - 2 * leaving(u, v, along) + leaving(u, v - h, along)) / h**2
    g = (np.log(radiance(u, v + h, along)) - np.log(radiance(u, v - h, along))) / (2 * h)
    inner = (slice(4, -4), slice(6, -6))
    assert np.isfinite(table[inner][..., surface.LEAVING]).all()
    np.testing.assert_allclose(table[inner][..., surface.LEAVING], a[inner], rtol=2e-3)
    np.testing.assert_allclose(table[inner][..., surface.BENDING], b[inner], rtol=0.05, atol=2e-5)
    np.testing.assert_allclose(table[inner][..., surface.SHADING], g[inner], rtol=0.06, atol=6e-4)
    point = on_sphere(u, v, along)
    normal = (CENTRE - point) / RADIUS
    normal[..., 1] += along / RADIUS
    np.testing.assert_allclose(table[inner][..., surface.NORMAL : surface.NORMAL + 3], normal[inner], atol=3e-3)


def test_the_noise_of_bending_and_shading_is_that_of_repeated_scans():
    rng = np.random.default_rng(4)
    found, told = [], []
    clean, _ = sphere()
    for _ in range(60):
        lattice, _ = sphere(0.01 * rng.standard_normal(clean.sigma.shape))
        light = np.log(lattice.peak * lattice.width) + 0.01 * rng.standard_normal(clean.sigma.shape)
        patches = np.full((*clean.sigma.shape, surface.PATCH), np.nan)
        table = np.full((6, clean.sigma.shape[1], surface.COLUMNS), np.nan)
        kept = surface.Patches((1, 2), patches, np.zeros(clean.sigma.shape, bool))
        surface.fit_patches(scan_of(lattice, light), kept, 8, 14, 1.0, table)
        row = table[:, 8:-8]
        found.append(row[..., surface.SHADING] - 1.5 * row[..., surface.BENDING] / row[..., surface.LEAVING])
        told.append(row[..., surface.NOISE])
    ratio = np.nanstd(found, axis=0) / np.nanmean(told, axis=0)  # one in 5,000 finds its patch not smooth
    assert 0.85 < np.median(ratio) < 1.15


def profile(t: np.ndarray, a: float, b: float, g: float, width: float) -> np.ndarray:
    return np.exp(-0.5 * ((a * t + 0.5 * b * t * t) / width) ** 2) * np.exp(g * t)


def fitted_shift(
    a: float, b: float, g: float, width: float, blur: float, gain: float, dark: float, peak: float
) -> float:
    """Where a weighted fit of a Gaussian places a blurred profile whose sheet is met at 0."""
    fine = np.linspace(-12.0, 12.0, 4801)
    pixel = np.arange(-9.0, 10.0)
    light = profile(fine, a, b, g, width)
    answer = ndtr((fine[None] - pixel[:, None] + 0.5) / blur) - ndtr((fine[None] - pixel[:, None] - 0.5) / blur)
    image = answer @ light
    image *= peak / image.max()

    def residual(q: np.ndarray) -> np.ndarray:
        model = q[0] * np.exp(-0.5 * ((pixel - q[1]) / q[2]) ** 2)
        return (image - model) / np.sqrt(dark + np.maximum(model, 0.0) / gain)

    best = np.array([peak, 0.0, 1.3])
    for _ in range(4):  # weights of the model found before: the score of the likelihood without its logarithm
        model = best[0] * np.exp(-0.5 * ((pixel - best[1]) / best[2]) ** 2)
        weight = 1.0 / np.sqrt(dark + model / gain)
        best = least_squares(
            lambda q, w=weight: (image - q[0] * np.exp(-0.5 * ((pixel - q[1]) / q[2]) ** 2)) * w, best
        ).x
    return float(best[1])


@pytest.mark.parametrize(("gain", "dark"), [(35.0, 1.5), (1e9, 1.0), (0.02, 1.5)])
@pytest.mark.parametrize(
    ("a", "b", "g"), [(0.3, 0.006, 0.0), (0.3, 0.0, 0.05), (0.25, 0.005, -0.04), (-0.35, 0.004, 0.02)]
)
def test_displacement_is_that_of_a_fit_to_the_exact_profile(a, b, g, gain, dark):
    lens, width = 0.6, 0.35
    true = fitted_shift(a, b, g, width, lens, gain, dark, 150.0)
    table = np.full((1, 1, surface.COLUMNS), np.nan)
    table[0, 0, [surface.LEAVING, surface.BENDING, surface.SHADING, surface.NOISE, surface.MISFIT]] = a, b, g, 0.0, 1.0
    lattice, _ = sphere()
    peak = np.full((1, 1), 150.0)
    one = Lattice(**{name: getattr(lattice, name)[:1, :1] for name in Lattice.__slots__ if name != "noise"} | {
        "noise": np.array([[gain, dark, 0.0]]), "peak": peak,
    })  # fmt: skip
    found, _, _, _ = slope.displacement(table, np.zeros((1, 1, 3)), np.full((1, 1), width), lens**2 + 1.0 / 12.0, one)
    assert abs(true) > 0.01
    assert found[0, 0] == pytest.approx(true, rel=0.15, abs=0.002)


def test_skew_moves_a_shot_noise_fit_not_at_all_and_an_even_fit_by_one_and_a_half():
    even = slope.answer_to_skew(1e-6, 1.0, 1.0, 0.0, slope.skews())
    shot = slope.answer_to_skew(1e3, 1.0, 1.0, 0.0, slope.skews())
    assert even == pytest.approx(-1.5, abs=0.01)
    assert abs(shot) < 0.1


def test_the_blur_of_a_bowed_stripe_is_that_of_its_image():
    """A stripe v = bow u^2 / 2 + tilt u, whose light grows, in two dimensions."""
    tilt, bow, growth, s, blur = 0.3, 0.03, 0.05, 1.1, 0.65
    fine = np.arange(-8.0, 8.01, 0.1)
    u, v = np.meshgrid(fine, fine, indexing="ij")
    image = np.exp(growth * u - 0.5 * ((v - tilt * u - 0.5 * bow * u**2) / s) ** 2)
    line = np.exp(-0.5 * (fine / blur) ** 2) @ image  # the lens along the stripe; across it nothing moves
    centroid = np.sum(fine * line) / np.sum(line)
    expected = blur**2 * (0.5 * bow + tilt * growth)
    assert centroid == pytest.approx(expected, rel=0.05)
    lines = np.arange(30.0)
    course = follow((tilt * lines + 0.5 * bow * lines**2)[None], np.exp(growth * lines)[None])
    np.testing.assert_allclose(course[0, 4:-4, 1], bow, atol=1e-9)
    np.testing.assert_allclose(course[0, 4:-4, 2], growth, atol=1e-9)
    np.testing.assert_allclose(course[0, 10, 0], tilt + 10 * bow, atol=1e-9)


@pytest.mark.parametrize(("gain", "dark"), [(35.0, 1.5), (1e9, 1.0)])
def test_a_fit_to_a_steep_and_bowed_stripe_is_displaced_as_computed(gain, dark):
    """At a limb beside: the lines' blur makes the profile skew, and a fit answers to that less than the mean does."""
    tilt, bow, growth, width, slope_of_surface, blur = 1.1, 0.25, 0.02, 0.35, 0.3, 0.6**2 + 1.0 / 12.0
    s0 = width / slope_of_surface
    fine = np.arange(-6.0, 6.01, 0.05)
    v = np.arange(-14.0, 14.5)
    answer = np.exp(-0.5 * fine**2 / blur + growth * fine)
    course = tilt * fine + 0.5 * bow * fine**2
    spread = np.sqrt(s0**2 + blur)
    image = (answer * np.exp(-0.5 * ((v[:, None] - course) / spread) ** 2)).sum(axis=1)
    image *= 150.0 / image.max()
    fit = np.array([150.0, 0.0, 2.0])
    for _ in range(5):
        weight = 1.0 / np.sqrt(dark + fit[0] * np.exp(-0.5 * ((v - fit[1]) / fit[2]) ** 2) / gain)
        fit = least_squares(lambda q, w=weight: (image - q[0] * np.exp(-0.5 * ((v - q[1]) / q[2]) ** 2)) * w, fit).x
    table = np.zeros((1, 1, surface.COLUMNS))
    table[0, 0, [surface.LEAVING, surface.MISFIT]] = slope_of_surface, 1.0
    lattice, _ = sphere()
    one = replace(lattice.rows(0, 1), peak=np.full((1, 1), 150.0), noise=np.array([[gain, dark, 0.0]]))
    found = slope.displacement(table, np.array([[[tilt, bow, growth]]]), np.full((1, 1), width), blur, one)
    assert fit[1] > 0.04
    assert found[0][0, 0] == pytest.approx(fit[1], rel=0.1)


def test_a_gap_or_a_jump_ends_a_course():
    position = np.linspace(0.0, 3.0, 31)[None].copy()
    position[0, 15:] += 5.0
    course = follow(position, np.ones_like(position))
    np.testing.assert_allclose(course[0, [13, 14, 15, 16], 0], 0.1, atol=1e-9)  # goes on as it came, on either side
    alone = np.where(np.arange(31) % 4 == 0, np.nan, position)
    assert not follow(alone, np.ones_like(position)).any()
    np.testing.assert_allclose(course[0, 5:11, 0], 0.1, atol=1e-9)


@pytest.mark.parametrize(("width", "blur"), [(0.3, 0.44), (0.2, 0.3), (0.5, 0.6)])
def test_width_of_sheet_and_blur_come_out_of_the_widths_of_stripes(width, blur):
    rng = np.random.default_rng(7)
    table = np.full((40, 200, surface.COLUMNS), np.nan)
    a = np.geomspace(0.15, 0.7, 200)[None] * np.ones((40, 1))
    table[..., surface.LEAVING], table[..., surface.MISFIT], table[..., surface.OWN] = a, 1.0, 1.0
    distance = 400.0 + 60.0 * rng.random(a.shape)
    seen = np.sqrt((width * np.sqrt(distance / 430.0) / a) ** 2 + blur) * (1 + 0.01 * rng.standard_normal(a.shape))
    beam = slope.estimate_beam(table, seen, np.zeros_like(a), distance)
    assert beam.width_at(np.array(430.0)) == pytest.approx(width, rel=0.02)
    assert beam.blur == pytest.approx(blur, abs=0.1)


def test_a_displaced_sphere_is_put_back_and_its_sigma_holds():
    """Positions are displaced as fits to the exact profiles of a few slopes say; what is left is noise."""
    start, lens = -7.0, 0.526  # px; these few slopes cannot tell the blur, so it is what is assumed of a lens
    lattice, a = sphere(start=start, width=0.45)
    u, along = grids(start=start)
    v, h, width = lattice.position, 0.05, 0.45
    b = (leaving(u, v + h, along) - 2 * leaving(u, v, along) + leaving(u, v - h, along)) / h**2
    g = (np.log(radiance(u, v + h, along)) - np.log(radiance(u, v - h, along))) / (2 * h)
    middle = u.shape[1] // 2
    shift = np.array(
        [fitted_shift(a[f, middle], b[f, middle], g[f, middle], width, lens, 35.0, 1.5, 120.0) for f in range(len(u))]
    )
    rng = np.random.default_rng(3)
    noise = 0.01 * rng.standard_normal(u.shape)
    seen, _ = sphere(shift[:, None] + noise, start=start, width=0.45, blur=lens**2 + 1.0 / 12.0)
    found = refine(seen, 0, len(u))
    # the blur along the bowed stripe, which these lines did not suffer, is taken off as well
    bow = slope.estimate_beam(
        slope.slopes(seen, 0, len(u)).table, seen.width, 0 * v, np.linalg.norm(seen.points, axis=2)
    ).blur
    bow = bow * 0.5 * follow(v, np.ones_like(v))[..., 1]
    error = found.position + bow - v
    core = (slice(5, -5), slice(10, -10))
    assert (found.reason[core] == Reason.RANGED).mean() > 0.99
    assert abs(np.mean(shift[5:-5])) > 0.012
    assert abs(np.nanmean(error[core])) < 0.0015
    per_px = seen.sigma / seen.sigma_px
    z = error[core] * per_px[core] / found.sigma[core]
    assert 0.8 < np.sqrt(np.nanmean(z**2)) < 1.25


def test_answers_depend_on_no_more_than_the_context():
    rng = np.random.default_rng(5)
    lattice, _ = sphere()
    noise = 0.01 * rng.standard_normal(lattice.sigma.shape)
    lattice, _ = sphere(noise)
    frames = len(lattice.camera)
    whole = slope.slopes(lattice, 11, 12)
    part = Lattice(**{name: getattr(lattice, name)[11 - CONTEXT : 12 + CONTEXT] for name in Lattice.__slots__})
    assert frames == 23
    np.testing.assert_array_equal(slope.slopes(part, CONTEXT, CONTEXT + 1).profile, whole.profile)

"""The surface about each point of a scan, from its neighbours along the stripe and from frame to frame.

A scan is a lattice: frames by lines. Where it is smooth, X(frame, line) is well described by a quadratic over five by five
of its points, and its derivatives tell the surface's normal, its curvature, and what a pixel that moves across the stripe
sees: how fast the surface leaves the sheet of light, and how that rate changes. How the shading changes is read off the
light of the neighbours' stripes, so that nothing need be known of the surface's reflectance. A point whose own
neighbourhood is no quadratic, since an edge cuts it, may still lie on one of the smooth patches beside it.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple, TypeAlias

import numpy as np

from calibration.compiled import compiled
from calibration.geometry import Array, Bools

Vector: TypeAlias = tuple[float, float, float]
Row: TypeAlias = Any  # one point of an array

# Columns of the table of patches: derivatives of X by strides of the lattice, three columns each.
BY_F, BY_L, BY_FF, BY_FL, BY_LL = 3, 6, 9, 12, 15  # the first three columns are its middle
CHI = 18  # chi squared a degree of freedom
LIGHT_F, LIGHT_L = 19, 20  # of the logarithm of the stripe's light
LIGHT_NOISE = 21  # variance of that logarithm about its plane
PATCH = 22
# Columns of the table of answers.
LEAVING = 0  # mm/px, d(distance from the sheet) / d(pixel across the stripe)
BENDING = 1  # mm/px^2, its derivative
SHADING = 2  # 1/px, d(log of the radiance) / d(pixel)
NOISE = 3  # 1/px, standard deviation of SHADING - 1.5 BENDING / LEAVING, from that of the points
MISFIT = 4  # chi squared a degree of freedom of the patch's points
NORMAL = 5  # unit, away from the camera; three columns
AWAY = 8  # distance of the point from the patch along the ray, over its standard deviation; 0 on its own patch
OWN = 9  # 1: the patch is about the point itself, and of the first stride; 0.5: of a smaller one; 0: borrowed
COLUMNS = 10

HALF = 2  # strides, from the middle of a patch to its border
FREEDOM = 25 - 6
SMOOTH = 2.5  # chi squared a degree of freedom: beyond, the surface is not a quadratic. 19 degrees: chance 2e-4
NEAREST = 3  # strides, to the middle of a patch beside a point that has no part in it


class Surface(NamedTuple):
    """A scan on its lattice, as patches are fitted to it; all in the cloud frame."""

    points: Array  # (F, L, 3) mm
    rays: Array  # (F, L, 3) unit, away from the camera
    moved: Array  # (F, L, 3) mm/px, of a point's ray when its pixel moves across the stripe
    sheet: Array  # (F, L, 3) unit normals of the sheet of light
    camera: Array  # (F, 3) mm
    sigma: Array  # (F, L) mm along the rays, NaN where there is no point
    light: Array  # (F, L) logarithm of the light on the line


class Patches(NamedTuple):
    """Patches of one stride, each fitted when it is first asked for."""

    stride: tuple[int, int]  # frames, lines
    rows: Array  # (F, L, PATCH)
    fitted: Bools  # (F, L)


@compiled
def fit_patch(scan: Surface, stride: tuple[int, int], f: int, i: int, row: Row) -> None:
    """Quadratic about the point of frame ``f`` and line ``i``, by least squares on the lattice.

    ``row`` (PATCH,) receives the answers, CHI NaN where one of the 25 points is missing. On a grid the polynomials
    1, a, b, a^2 - 2, a b, b^2 - 2 are orthogonal, so that each coefficient is a sum.
    """
    points, rays, _, _, _, sigma, light = scan
    frames, lines = sigma.shape
    row[CHI] = np.nan
    if not sigma[f, i] > 0.0:
        return
    if f - HALF * stride[0] < 0 or f + HALF * stride[0] >= frames:
        return
    if i - HALF * stride[1] < 0 or i + HALF * stride[1] >= lines:
        return
    e = _vector(rays[f, i])
    o = _vector(points[f, i])
    s0 = s1 = s2 = a0 = a1 = a2 = b0 = b1 = b2 = 0.0
    aa0 = aa1 = aa2 = ab0 = ab1 = ab2 = bb0 = bb1 = bb2 = 0.0
    square = variance = 0.0
    m = mm = ma = mb = 0.0
    for a in range(-HALF, HALF + 1):
        g = f + a * stride[0]
        r0 = r1 = r2 = u0 = u1 = u2 = v0 = v1 = v2 = 0.0
        for b in range(-HALF, HALF + 1):
            j = i + b * stride[1]
            x, y, z = points[g, j, 0] - o[0], points[g, j, 1] - o[1], points[g, j, 2] - o[2]
            h = x * e[0] + y * e[1] + z * e[2]
            square += h * h
            variance += sigma[g, j] * sigma[g, j]
            glow = light[g, j] - light[f, i]
            m, mm, ma, mb = m + glow, mm + glow * glow, ma + a * glow, mb + b * glow
            r0, r1, r2 = r0 + x, r1 + y, r2 + z
            u0, u1, u2 = u0 + b * x, u1 + b * y, u2 + b * z
            c = b * b - 2
            v0, v1, v2 = v0 + c * x, v1 + c * y, v2 + c * z
        c = a * a - 2
        s0, s1, s2 = s0 + r0, s1 + r1, s2 + r2
        a0, a1, a2 = a0 + a * r0, a1 + a * r1, a2 + a * r2
        b0, b1, b2 = b0 + u0, b1 + u1, b2 + u2
        aa0, aa1, aa2 = aa0 + c * r0, aa1 + c * r1, aa2 + c * r2
        ab0, ab1, ab2 = ab0 + a * u0, ab1 + a * u1, ab2 + a * u2
        bb0, bb1, bb2 = bb0 + v0, bb1 + v1, bb2 + v2
    if not square + variance < 1e12:  # a point is missing
        return
    square -= _dot((s0, s1, s2), e) ** 2 / 25.0
    square -= (_dot((a0, a1, a2), e) ** 2 + _dot((b0, b1, b2), e) ** 2) / 50.0
    square -= (_dot((aa0, aa1, aa2), e) ** 2 + _dot((bb0, bb1, bb2), e) ** 2) / 70.0
    square -= _dot((ab0, ab1, ab2), e) ** 2 / 100.0
    for k, value in enumerate((
        s0 / 25.0 - (aa0 + bb0) / 35.0, s1 / 25.0 - (aa1 + bb1) / 35.0, s2 / 25.0 - (aa2 + bb2) / 35.0,
        a0 / 50.0, a1 / 50.0, a2 / 50.0, b0 / 50.0, b1 / 50.0, b2 / 50.0, aa0 / 35.0, aa1 / 35.0, aa2 / 35.0,
        ab0 / 100.0, ab1 / 100.0, ab2 / 100.0, bb0 / 35.0, bb1 / 35.0, bb2 / 35.0,
    )):  # fmt: skip
        row[k] = value
    row[0], row[1], row[2] = row[0] + o[0], row[1] + o[1], row[2] + o[2]
    row[CHI] = max(square, 0.0) / FREEDOM / (variance / 25.0)
    row[LIGHT_F], row[LIGHT_L] = ma / 50.0, mb / 50.0
    row[LIGHT_NOISE] = max(mm - m * m / 25.0 - (ma * ma + mb * mb) / 50.0, 0.0) / 22.0


@compiled
def fit_patches(scan: Surface, kept: Patches, first: int, last: int, own: float, table: Array) -> None:
    """What the surface does across the stripe at every point of frames ``first`` to ``last`` - 1.

    Parameters
    ----------
    scan : Surface
    kept : Patches
        Those of this stride.
    own : float
        What OWN becomes of points whose own patch is smooth; 0: the others are to borrow one.
    table : (last - first, L, COLUMNS) array
        Receives the answers; rows that already have a smooth patch stay as they are. MISFIT says how good the patch
        is: where the point's own patch is not `SMOOTH`, a smooth patch beside it is taken, of eight the one that the
        point is nearest to.
    """
    points, rays, moved, sheet, camera, sigma, _ = scan
    stride, patches, fitted = kept
    frames, lines = sigma.shape
    for f in range(first, last):
        for i in range(lines):
            row = table[f - first, i]
            if not sigma[f, i] > 0.0 or row[MISFIT] < SMOOTH:
                continue
            best_a, best_b = 0, 0
            away = 0.0
            if not fitted[f, i]:
                fit_patch(scan, stride, f, i, patches[f, i])
                fitted[f, i] = True
            if not patches[f, i, CHI] < SMOOTH:
                if own > 0.0:
                    continue
                nearest = np.inf
                for corners in (False, True):  # prolonged both ways, a patch says less: only where no other is smooth
                    if nearest < np.inf:
                        break
                    for a in range(-NEAREST, NEAREST + 1, NEAREST):
                        for b in range(-NEAREST, NEAREST + 1, NEAREST):
                            g, j = f + a * stride[0], i + b * stride[1]
                            if (a * b != 0) != corners or g < 0 or g >= frames or j < 0 or j >= lines:
                                continue
                            if not fitted[g, j]:
                                fit_patch(scan, stride, g, j, patches[g, j])
                                fitted[g, j] = True
                            if not patches[g, j, CHI] < SMOOTH:
                                continue
                            point, ray = _vector(points[f, i]), _vector(rays[f, i])
                            gap = _away(patches[g, j], point, ray, -a, -b, sigma[f, i], sigma[g, j])
                            if abs(gap) < abs(nearest):
                                nearest, best_a, best_b = gap, a, b
                if nearest == np.inf:
                    row[MISFIT] = patches[f, i, CHI]
                    continue
                away = nearest
            g, j = f + best_a * stride[0], i + best_b * stride[1]
            row[MISFIT] = patches[g, j, CHI]
            row[AWAY], row[OWN] = away, own
            at = _vector(rays[f, i]), _vector(moved[f, i]), _vector(sheet[f, i]), _between(camera[f], points[f, i])
            _optics(patches[g, j], (-best_a, -best_b), at, sigma[f, i], row)


@compiled
def _away(patch: Row, point: Vector, ray: Vector, a: int, b: int, sigma: float, around: float) -> float:
    """Distance of a point from a patch, prolonged by (a, b) strides, along the ray, over its standard deviation."""
    d = [0.0, 0.0, 0.0]
    u = [0.0, 0.0, 0.0]
    v = [0.0, 0.0, 0.0]
    for k in range(3):
        d[k] = point[k] - patch[k] - a * patch[BY_F + k] - b * patch[BY_L + k]
        d[k] -= 0.5 * a * a * patch[BY_FF + k] + a * b * patch[BY_FL + k] + 0.5 * b * b * patch[BY_LL + k]
        u[k] = patch[BY_F + k] + a * patch[BY_FF + k] + b * patch[BY_FL + k]
        v[k] = patch[BY_L + k] + a * patch[BY_FL + k] + b * patch[BY_LL + k]
    normal = _cross((u[0], u[1], u[2]), (v[0], v[1], v[2]))
    gap = _dot((d[0], d[1], d[2]), normal) / _dot(ray, normal)
    aa, bb = a * a - 2.0, b * b - 2.0
    prolonged = 1.0 / 25.0 + (a * a + b * b) / 50.0 + (aa * aa + bb * bb) / 70.0 + (a * a * b * b) / 100.0
    return gap / math.sqrt(sigma * sigma + prolonged * around * around)


@compiled
def _optics(
    patch: Row, strides: tuple[int, int], at: tuple[Vector, Vector, Vector, Vector], sigma: float, row: Row
) -> None:
    """Motion X' and X'' of the point that a pixel sees as it moves across the stripe, and how its light changes.

    The point lies ``strides`` from the middle of the patch; ``at`` it are the ray, its shift by a pixel across the stripe,
    the normal of the sheet, and the way from the camera.

    X stays on the patch, whose second fundamental form tells the part of X'' along the normal, and on a ray that turns
    evenly about the camera, which tells the rest: X'' = (2 rho' / rho) m + lambda ray, with rho the distance and m the
    ray's shift square to itself. The light M on a line is radiance times width, w / |n . X'|; as the stripe moves on over
    the surface its normal turns, and with it n . X' by (n . ray) II(X', X') / (N . ray).
    """
    (a, b), (ray, shift, sheet, sight) = strides, at
    u = (
        patch[BY_F] + a * patch[BY_FF] + b * patch[BY_FL],
        patch[BY_F + 1] + a * patch[BY_FF + 1] + b * patch[BY_FL + 1],
        patch[BY_F + 2] + a * patch[BY_FF + 2] + b * patch[BY_FL + 2],
    )
    v = (
        patch[BY_L] + a * patch[BY_FL] + b * patch[BY_LL],
        patch[BY_L + 1] + a * patch[BY_FL + 1] + b * patch[BY_LL + 1],
        patch[BY_L + 2] + a * patch[BY_FL + 2] + b * patch[BY_LL + 2],
    )
    normal = _cross(u, v)
    size = math.sqrt(_dot(normal, normal))
    size = size if _dot(normal, ray) > 0.0 else -size
    normal = (normal[0] / size, normal[1] / size, normal[2] / size)
    facing = _dot(normal, ray)
    tangent = _minus(shift, ray, _dot(normal, shift) / facing)
    uu, uv, vv = _dot(u, u), _dot(u, v), _dot(v, v)
    area = uu * vv - uv * uv
    tu, tv = _dot(tangent, u), _dot(tangent, v)
    du, dv = (vv * tu - uv * tv) / area, (uu * tv - uv * tu) / area  # strides a pixel
    nff = _dot(normal, (patch[BY_FF], patch[BY_FF + 1], patch[BY_FF + 2]))
    nfl = _dot(normal, (patch[BY_FL], patch[BY_FL + 1], patch[BY_FL + 2]))
    nll = _dot(normal, (patch[BY_LL], patch[BY_LL + 1], patch[BY_LL + 2]))
    bend_u, bend_v = nff * du + nfl * dv, nfl * du + nll * dv
    square = _minus(shift, ray, _dot(shift, ray))
    turning = 2.0 * _dot(tangent, ray) / math.sqrt(_dot(sight, sight))
    along_ray = (bend_u * du + bend_v * dv - turning * _dot(normal, square)) / facing
    leaving = _dot(sheet, tangent)
    bending = turning * _dot(sheet, square) + along_ray * _dot(sheet, ray)
    row[LEAVING] = leaving
    row[BENDING] = bending
    curving = _dot(sheet, ray) / (facing * leaving)
    row[SHADING] = patch[LIGHT_F] * du + patch[LIGHT_L] * dv + curving * (bend_u * du + bend_v * dv)
    row[NORMAL], row[NORMAL + 1], row[NORMAL + 2] = normal[0], normal[1], normal[2]
    # the second derivatives err by sigma (normal . ray) times the root of 4/70, 1/100 and 4/70; first ones by 1/50
    by_bend = 0.5 * curving * sigma * facing
    bend = by_bend * by_bend * ((du * du * du * du + dv * dv * dv * dv) * (4.0 / 70.0) + du * du * dv * dv * 0.04)
    row[NOISE] = math.sqrt(bend + patch[LIGHT_NOISE] * (du * du + dv * dv) / 50.0)


@compiled
def _vector(row: Row) -> Vector:
    return (row[0], row[1], row[2])


@compiled
def _between(start: Row, end: Row) -> Vector:
    return (end[0] - start[0], end[1] - start[1], end[2] - start[2])


@compiled
def _dot(a: Vector, b: Vector) -> float:
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


@compiled
def _cross(a: Vector, b: Vector) -> Vector:
    return (a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0])


@compiled
def _minus(a: Vector, b: Vector, share: float) -> Vector:
    """Difference a - share b."""
    return (a[0] - share * b[0], a[1] - share * b[1], a[2] - share * b[2])

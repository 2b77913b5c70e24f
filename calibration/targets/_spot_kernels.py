"""The loops over pixels behind `calibration.targets.spots`, compiled by numba.

Three steps, one function each: a binary image to components, a component to the levels and moments of one spot, and a
spot to the fit of its edge. Images are indexed (row, column); every spot is brighter than what surrounds it (the caller
changes the sign of dark ones). Importing this module loads numba.

An ellipse is written as the matrix G for which its outline has the support function h(n) = sqrt(n' G n): a circle of
radius R has G = R^2 I. The signed distance of a pixel from the outline is taken as (rho - 1) rho / |Q x|, Q = G^-1,
rho^2 = x' Q x, which is exact for circles and exact to first order near the outline of any ellipse.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from calibration.compiled import cached
from calibration.geometry import Array

Image32 = NDArray[np.float32]
Labels = NDArray[np.int32]

#: Columns of the table of `components`; bounds are inclusive.
AREA, TOP, BOTTOM, LEFT, RIGHT, SUM_U, SUM_V, SUM_UU, SUM_UV, SUM_VV = range(10)
#: Columns of the table of `shapes`, the first eight of which `edges` reads.
U, V, GUU, GUV, GVV, LEVEL, GROUND, BLUR = range(8)
NOISE_IN, NOISE_OUT, TRIANGLE, SQUARE, SKEW, CLIPPED, FILL, TEXTURE, HALO = range(8, 17)
#: Columns of the table of `edges`: U to GVV as above, then these.
E_BLUR, CUU, CUV, CVV, CHI2, COUNT, RAGGED = range(5, 12)

_DEAD = 0.04  # part of the contrast, at either end, that counts as background or plateau: noise there adds nothing
_BUFFER = 4096  # most pixels of a plateau or a ring that are looked at
_REACH = 4.0  # the profile of an edge is tabulated up to so many blurs from it
_STEPS = 64.0  # so many entries a blur


def _profile() -> tuple[Array, Array]:
    """Cumulative (falling) and density of the normal distribution over -4 to 4, in steps of 1/64."""
    x = np.arange(-_REACH, _REACH + 2.5 / _STEPS, 1.0 / _STEPS)
    return np.array([0.5 * math.erfc(t / math.sqrt(2.0)) for t in x]), np.exp(-0.5 * x * x) / math.sqrt(2.0 * math.pi)


_INSIDE, _DENSITY = _profile()
# Integral of w (1 - w) over an edge of unit blur, for the membership w with its dead ends: turns a sum into a blur.
_W = np.clip((_INSIDE - _DEAD) / (1.0 - 2.0 * _DEAD), 0.0, 1.0)
_SOFT = float(np.sum(_W * (1.0 - _W)) / _STEPS)


def _find(parent: Labels, i: int) -> int:
    while parent[i] != i:
        parent[i] = parent[parent[i]]
        i = parent[i]
    return i


_find = cached()(_find)


def _components(mask: NDArray[np.uint8], least: int) -> tuple[Labels, Array]:
    height, width = mask.shape
    capacity = height * ((width + 1) // 2)
    row = np.empty(capacity, np.int32)
    start = np.empty(capacity, np.int32)
    stop = np.empty(capacity, np.int32)
    parent = np.empty(capacity, np.int32)
    n, above, above_end = 0, 0, 0
    for v in range(height):
        first, u, j = n, 0, above
        while u < width:
            if mask[v, u] == 0:
                u += 1
                continue
            begin = u
            while u < width and mask[v, u] != 0:
                u += 1
            row[n], start[n], stop[n], parent[n] = v, begin, u, n
            while j < above_end and stop[j] < begin:
                j += 1
            i = j
            while i < above_end and start[i] <= u:
                a, b = _find(parent, i), _find(parent, n)
                parent[max(a, b)] = min(a, b)
                i += 1
            n += 1
        above, above_end = first, n
    area = np.zeros(n, np.int32)
    for i in range(n):
        area[_find(parent, i)] += stop[i] - start[i]
    name = np.zeros(n, np.int32)
    count = 0
    for i in range(n):
        if parent[i] == i and area[i] >= least:
            count += 1
            name[i] = count
    labels = np.zeros((height, width), np.int32)
    table = np.zeros((count, 10))
    for i in range(n):
        label = name[_find(parent, i)]
        if label == 0:
            continue
        t = table[label - 1]
        v, u0, u1 = row[i], start[i], stop[i]
        if t[AREA] == 0:
            t[TOP], t[LEFT], t[RIGHT] = v, u0, u1 - 1
        t[AREA] += u1 - u0
        t[BOTTOM] = v
        t[LEFT] = min(t[LEFT], u0)
        t[RIGHT] = max(t[RIGHT], u1 - 1)
        for u in range(u0, u1):
            labels[v, u] = label
            t[SUM_U] += u
            t[SUM_V] += v
            t[SUM_UU] += u * u
            t[SUM_UV] += u * v
            t[SUM_VV] += v * v
    return labels, table


def _shapes(image: Image32, labels: Labels, table: Array, clip: float) -> Array:
    """Levels, noise and moments of every spot, each turn from the outline and the blur of the turn before.

    One loop: fifteen sums over the pixels of a spot grow together, and cut apart each part would read the pixels again.
    """
    height, width = image.shape
    out = np.full((len(table), 17), np.nan)
    inner, outer = np.empty(_BUFFER), np.empty(_BUFFER)
    beside, around = np.empty(_BUFFER), np.empty(_BUFFER)
    for k in range(len(table)):
        n = table[k, AREA]
        cu, cv = table[k, SUM_U] / n, table[k, SUM_V] / n
        # n pixels are n little squares: each adds a twelfth to the second moments
        suu = table[k, SUM_UU] / n - cu * cu + 1.0 / 12.0
        suv = table[k, SUM_UV] / n - cu * cv
        svv = table[k, SUM_VV] / n - cv * cv + 1.0 / 12.0
        blur = 1.0
        for _turn in range(3):
            det = suu * svv - suv * suv
            quu, quv, qvv = svv / det / 4, -suv / det / 4, suu / det / 4
            near, ring = max(2.0, 2.5 * blur), 3.0 * blur
            far = ring + max(3.0, 0.8 * det**0.25)
            v0, v1 = max(0, int(cv - 2 * math.sqrt(svv) - far)), min(height, int(cv + 2 * math.sqrt(svv) + far) + 2)
            u0, u1 = max(0, int(cu - 2 * math.sqrt(suu) - far)), min(width, int(cu + 2 * math.sqrt(suu) + far) + 2)
            # levels: a plateau well inside the edge, a ring well outside it; a lattice of pixels is enough
            n_in, n_out, top = 0, 0, -np.inf
            step = 1 + int(math.sqrt((v1 - v0) * (u1 - u0) / 600.0))
            for v in range(v0, v1, step):
                y = v - cv
                for u in range(u0, u1, step):
                    owner = labels[v, u]
                    if owner != 0 and owner != k + 1:
                        continue
                    x = u - cu
                    nu, nv = quu * x + quv * y, quv * x + qvv * y
                    rho2 = nu * x + nv * y
                    d = (rho2 - math.sqrt(rho2)) / math.sqrt(nu * nu + nv * nv + 1e-18)
                    if owner != 0:
                        top = max(top, image[v, u])
                        if (d < -near or rho2 < 0.1) and n_in < _BUFFER:
                            inner[n_in] = image[v, u]
                            beside[n_in] = image[v, u + 1] if u + 1 < width else image[v, u]
                            n_in += 1
                    elif ring < d < far and n_out < _BUFFER:
                        outer[n_out] = image[v, u]
                        around[n_out] = image[v, u + 1] if u + 1 < width else image[v, u]
                        n_out += 1
            if n_out < 6:
                break
            ground = np.median(outer[:n_out])
            level = np.median(inner[:n_in]) if n_in > 0 else top
            contrast = level - ground
            if not contrast > 0.0:
                break
            # moments of the membership, within reach of the edge
            s0 = su = sv = tuu = tuv = tvv = soft = over = 0.0
            c3r = c3i = c4r = c4i = skr = ski = 0.0
            a, b, c = 0.5 / math.sqrt(suu), -suv / suu, 0.5 / math.sqrt(det / suu)
            scale, reach = 1.0 / contrast / (1.0 - 2.0 * _DEAD), 2.5 * blur + 0.5
            for v in range(v0, v1):
                y = v - cv
                for u in range(u0, u1):
                    w = (image[v, u] - ground) * scale - _DEAD / (1.0 - 2.0 * _DEAD)
                    owner = labels[v, u]
                    if w <= 0.0 or (owner != 0 and owner != k + 1):
                        continue
                    x = u - cu
                    if owner == 0:
                        nu, nv = quu * x + quv * y, quv * x + qvv * y
                        rho2 = nu * x + nv * y
                        if rho2 - math.sqrt(rho2) > reach * math.sqrt(nu * nu + nv * nv):
                            continue
                    if image[v, u] >= clip:
                        over += 1.0
                    w = min(w, 1.0)
                    s0 += w
                    su += w * x
                    sv += w * y
                    tuu += w * x * x
                    tuv += w * x * y
                    tvv += w * y * y
                    soft += w * (1.0 - w)
                    # harmonics of the outline, in the frame where the spot is the unit disk
                    p, q = a * x, c * (y + b * x)
                    p2, q2 = p * p - q * q, 2 * p * q
                    c3r += w * (p2 * p - q2 * q)
                    c3i += w * (p2 * q + q2 * p)
                    c4r += w * (p2 * p2 - q2 * q2)
                    c4i += w * 2 * p2 * q2
                    skr += w * p * (p * p + q * q - 2.0 / 3.0)
                    ski += w * q * (p * p + q * q - 2.0 / 3.0)
            if s0 < 3.0:
                break
            su, sv = su / s0, sv / s0
            suu, suv, svv = tuu / s0 - su * su, tuv / s0 - su * sv, tvv / s0 - sv * sv
            det = suu * svv - suv * suv
            if not det > 0.0:
                break
            cu, cv = cu + su, cv + sv
            # the area gives the radius of the half level, the moments give the shape
            fill = s0 / (4 * math.pi * math.sqrt(det))
            suu, suv, svv = suu * fill, suv * fill, svv * fill
            assumed = blur
            blur = soft / _SOFT / (2 * math.pi * math.sqrt(2 * (suu + svv)))
            blur = min(max(blur, 0.3), 0.3 + 0.3 * math.sqrt(s0))
            if n_in >= 4:
                out[k, NOISE_IN] = np.var(inner[:n_in])
                out[k, TEXTURE] = np.mean((inner[:n_in] - level) * (beside[:n_in] - level)) / contrast**2
            spread = 4 * (1.4826 * np.median(np.abs(outer[:n_out] - ground)) + 0.5)
            total, count = 0.0, 0
            for i in range(n_out):
                if abs(outer[i] - ground) < spread:
                    total += (outer[i] - ground) ** 2
                    count += 1
            out[k, HALO] = np.mean((outer[:n_out] - ground) * (around[:n_out] - ground)) / contrast**2
            if count >= 6:
                out[k, NOISE_OUT] = total / count
            out[k, U], out[k, V], out[k, GUU], out[k, GUV], out[k, GVV] = cu, cv, 4 * suu, 4 * suv, 4 * svv
            out[k, LEVEL], out[k, GROUND], out[k, BLUR], out[k, CLIPPED], out[k, FILL] = (
                level,
                ground,
                blur,
                over / s0,
                fill,
            )
            out[k, TRIANGLE] = math.sqrt(c3r * c3r + c3i * c3i) / s0
            out[k, SQUARE] = math.sqrt(c4r * c4r + c4i * c4i) / s0
            out[k, SKEW] = math.sqrt(skr * skr + ski * ski) / s0
            if blur < 1.2 * assumed:
                break
    return out


def _solve(m: Array, b: Array, inverse: Array) -> bool:
    """Cholesky solution of the 6x6 normal equations, in place of ``b``, with the leading 2x2 block of the inverse."""
    n = len(b)
    for p in range(n):
        for q in range(p + 1):
            total = m[p, q]
            for r in range(q):
                total -= m[p, r] * m[q, r]
            if p == q:
                if not total > 0.0:
                    return False
                m[p, p] = math.sqrt(total)
            else:
                m[p, q] = total / m[q, q]
    for column in range(3):
        x = b if column == 2 else inverse[column]
        if column < 2:
            x[:] = 0.0
            x[column] = 1.0
        for p in range(n):
            total = x[p]
            for r in range(p):
                total -= m[p, r] * x[r]
            x[p] = total / m[p, p]
        for p in range(n - 1, -1, -1):
            total = x[p]
            for r in range(p + 1, n):
                total -= m[r, p] * x[r]
            x[p] = total / m[p, p]
    return True


_solve = cached(error_model="numpy")(_solve)


def _dot(a: Array, b: Array, n: int) -> float:
    total = 0.0
    for i in range(n):
        total += a[i] * b[i]
    return total


# sums may be reordered here, which lets them run several at a time
_dot = cached(fastmath=True)(_dot)


class EdgeRules(NamedTuple):
    """How edges are fitted."""

    ragged: float  # px^2, variance of the outlines
    low: float  # part of the contrast, below which light is cut off
    high: float  # likewise above
    turns: int  # steps of Gauss and Newton at most
    cut: float  # standard deviations at which a residual is cut


def _edges(image: Image32, labels: Labels, owner: Labels, spots: Array, noise: Array, rules: EdgeRules) -> Array:
    """Fit the edge of every spot: position, shape and blur by least squares over the pixels about its outline.

    One loop: a pixel's row of the normal equations is made from a dozen numbers of its spot, and handing them from function
    to function a pixel costs more time than the arithmetic.
    """
    height, width = image.shape
    ragged, low, high, turns, cut = rules
    out = np.full((len(spots), 12), np.nan)
    m, step, inverse = np.empty((6, 6)), np.empty(6), np.empty((2, 6))
    j = np.empty((8, _BUFFER))
    for k in range(len(spots)):
        cu, cv, guu, guv, gvv, level, ground, blur = spots[k, :8]
        contrast = level - ground
        chi2, rough, count = 1.0, 0.0, 0
        good = True
        for _turn in range(turns):
            det = guu * gvv - guv * guv
            if not (det > 0.0 and guu > 0.0):
                good = False
                break
            quu, quv, qvv = gvv / det, -guv / det, guu / det
            band = 3.2 * blur + 0.3
            v0, v1 = max(0, int(cv - math.sqrt(gvv) - band)), min(height, int(cv + math.sqrt(gvv) + band) + 2)
            u0, u1 = max(0, int(cu - math.sqrt(guu) - band)), min(width, int(cu + math.sqrt(guu) + band) + 2)
            if (v1 - v0) * (u1 - u0) > j.shape[1]:
                j = np.empty((8, 2 * (v1 - v0) * (u1 - u0)))
            count = 0
            limit = cut * math.sqrt(max(1.0, chi2))
            for v in range(v0, v1):
                y = v - cv
                for u in range(u0, u1):
                    if labels[v, u] != 0 and labels[v, u] != owner[k]:
                        continue
                    x = u - cu
                    nu, nv = quu * x + quv * y, quv * x + qvv * y
                    rho2 = nu * x + nv * y
                    if rho2 < 0.02:
                        continue
                    rho, slant = math.sqrt(rho2), 1.0 / math.sqrt(nu * nu + nv * nv)
                    d = (rho2 - rho) * slant
                    if d > band or d < -band:
                        continue
                    t = d / blur
                    f = (min(max(t, -_REACH), _REACH) + _REACH) * _STEPS
                    i = int(f)
                    f -= i
                    inside = _INSIDE[i] + f * (_INSIDE[i + 1] - _INSIDE[i])
                    slope = contrast * (_DENSITY[i] + f * (_DENSITY[i + 1] - _DENSITY[i])) / blur
                    pure = noise[k, 0] + inside * (noise[k, 1] - noise[k, 0])
                    weight = 1.0 / math.sqrt(pure + ragged * slope * slope)
                    seen = min(max((image[v, u] - ground) / contrast, low), high)
                    if inside < low or inside > high:
                        slope = 0.0
                        inside = min(max(inside, low), high)
                    residual = contrast * (seen - inside) * weight
                    slope *= weight
                    nu, nv, e = nu * slant, nv * slant, 0.5 * slope / (rho * slant)
                    j[0, count], j[1, count] = slope * nu, slope * nv
                    j[2, count], j[3, count], j[4, count] = e * nu * nu, 2 * e * nu * nv, e * nv * nv
                    j[5, count], j[6, count] = slope * t, min(max(residual, -limit), limit)
                    j[7, count] = pure * weight * weight
                    count += 1
            if count < 12:
                good = False
                break
            for p in range(6):
                step[p] = _dot(j[p], j[6], count)
                for q in range(p + 1):
                    m[p, q] = _dot(j[p], j[q], count)
                m[p, p] *= 1.0 + 1e-9
            if not _solve(m, step, inverse):
                good = False
                break
            # what is left after the step, to first order: its size, and its excess where the edge is steep
            total, upper, lower = 0.0, 0.0, 1e-300
            for i in range(count):
                rest = j[6, i]
                for p in range(6):
                    rest -= step[p] * j[p, i]
                slope2 = j[0, i] ** 2 + j[1, i] ** 2
                total += rest * rest
                upper += (rest * rest - j[7, i] * (1.0 - 6.0 / count)) * slope2
                lower += slope2 * slope2
            chi2, rough = total / max(count - 6, 1), upper / lower
            length = math.sqrt(step[0] ** 2 + step[1] ** 2)
            damp = min(1.0, 1.0 / (length + 1e-12))
            cu, cv = cu + damp * step[0], cv + damp * step[1]
            guu, guv, gvv = guu + damp * step[2], guv + damp * step[3], gvv + damp * step[4]
            wider = damp * step[5]
            blur = min(max(blur + wider, 0.6 * blur), 1.6 * blur)
            bent = (abs(step[2]) + abs(step[3]) + abs(step[4])) / math.sqrt(guu + gvv)
            if length < 0.03 * blur and abs(wider) < 0.1 * blur and bent < 0.15 * blur:
                break
        if not good:
            continue
        out[k, U], out[k, V], out[k, GUU], out[k, GUV], out[k, GVV], out[k, E_BLUR] = cu, cv, guu, guv, gvv, blur
        out[k, CUU], out[k, CUV], out[k, CVV] = inverse[0, 0], inverse[0, 1], inverse[1, 1]
        out[k, CHI2], out[k, COUNT], out[k, RAGGED] = chi2, count, rough
    return out


#: ``components(mask, least) -> labels, table``: the 8-connected components of at least ``least`` pixels, by runs and
#: union-find; the label image holds 0 or row + 1 of the table of areas, bounds and sums.
components = cached()(_components)
#: ``shapes(image, labels, table, clip) -> (K, 15)``: levels, grey moments, blur, noise and harmonics of components.
shapes = cached(error_model="numpy")(_shapes)
#: ``edges(image, labels, owner, spots, noise, ragged, turns, cut) -> (K, 12)``: Gauss-Newton fit of centre, ellipse and
#: blur to the pixels near the edge. Pixels are weighted by 1 / (noise + ragged * slope^2) and residuals beyond ``cut``
#: standard deviations are cut to that; ``noise`` (K, 2) holds the variances of background and plateau.
edges = cached(error_model="numpy")(_edges)

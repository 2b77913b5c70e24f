"""What a freehand camera has earned: terms, standard errors, coverage, and what does not pass, against an independent pinhole."""

from __future__ import annotations

import csv
import json
from pathlib import Path

import cv2
import numpy as np
import pytest
from typer.testing import CliRunner

from calibration.geometry import Pose
from calibration.rays import PlaneMarks, coverage_of, fit_freehand, folds, next_view, undetermined
from calibration.rays.bundle import adjust
from cli.main import app

GOOD = {
    "lens": [900.0, 900.0, 655.0, 470.0, -0.25, 0.12, 0.0008, -0.0005, -0.03], "size": (1280, 960), "board": (7, 9, 12.0), "tilt": 35.0,
    "spread": 0.8, "depth": (150.0, 260.0), "noise": 0.1, "count": 12,
}  # fmt: skip
SMALL = {  # a small board near the middle of the image, as a hand holds it at arm's length
    "lens": [600.0, 600.0, 330.0, 228.0, -0.1, 0.02, 0.0, 0.0, 0.0], "size": (640, 480), "board": (5, 5, 8.0), "tilt": 30.0, "spread": 0.3,
    "depth": (280.0, 400.0), "noise": 0.2, "count": 10,
}  # fmt: skip


def views(seed: int, told: dict, tilt: float | None = None) -> list[PlaneMarks]:
    """Views of a board at random, all of it in the image."""
    rng = np.random.default_rng(seed)
    lens, size = np.array(told["lens"]), np.array(told["size"], dtype=np.float64)
    rows, columns, pitch = told["board"]
    at = np.stack(np.meshgrid(np.arange(columns) - (columns - 1) / 2, np.arange(rows) - (rows - 1) / 2), axis=-1)
    points = pitch * at.reshape(-1, 2)
    matrix = np.array([[lens[0], 0, lens[2]], [0, lens[1], lens[3]], [0, 0, 1]])
    widest = told["tilt"] if tilt is None else tilt
    found: list[PlaneMarks] = []
    while len(found) < told["count"]:
        turn, depth = np.deg2rad(rng.uniform(-widest, widest, 3)), rng.uniform(*told["depth"])
        middle = size / 2 * (1 + rng.uniform(-told["spread"], told["spread"], 2))
        shift = np.append((middle - lens[2:4]) / lens[:2] * depth, depth)
        pixels = cv2.projectPoints(np.column_stack([points, np.zeros(len(points))]), turn, shift, matrix, lens[4:])[0]
        pixels = pixels[:, 0]
        if (pixels < 0).any() or (pixels > size - 1).any():
            continue
        pixels = pixels + rng.normal(0, told["noise"], pixels.shape)
        number, unknown = np.arange(len(points)), np.full((len(points), 2, 2), np.nan)
        found.append(PlaneMarks(f"v{len(found)}", pixels, points, Pose.identity(), number, unknown))
    return found


def parameters(fit) -> np.ndarray:
    return np.array([*fit.camera.matrix[[0, 1, 0, 1], [0, 1, 2, 2]], *fit.camera.distortion])


def test_a_lens_is_as_far_from_the_truth_as_its_standard_errors_say() -> None:
    off = []
    for seed in range(8):
        fit = fit_freehand(views(seed, GOOD), GOOD["size"])
        off.append((parameters(fit) - GOOD["lens"]) / np.sqrt(np.diag(fit.camera.covariance)))
        assert {"centre", "k1", "k2"} <= fit.terms
    assert np.sqrt(np.mean(np.square(off))) == pytest.approx(1.0, abs=0.25)


def test_a_small_board_earns_few_terms_and_says_what_it_leaves_open() -> None:
    off, terms = [], 0
    for seed in range(8):
        fit = fit_freehand(views(seed, SMALL), SMALL["size"])
        off.append((fit.camera.matrix[0, 0] - 600.0) / np.sqrt(fit.camera.covariance[0, 0]))
        terms += len(fit.terms)
        assert np.abs(fit.camera.distortion).max() < 5.0  # 251 where all five are fitted
        (reason,) = undetermined(fit, next_view(fit).advice)
        assert "do not determine the focal length to 5 %" in reason
        assert "tilt it by 30 degrees about" in reason
    assert terms < 2 * 8
    assert np.sqrt(np.mean(np.square(off))) < 1.5


def test_the_view_that_is_advised_makes_the_focal_length_surer_than_another_of_the_same() -> None:
    flat = views(3, SMALL, tilt=8.0)
    fit = fit_freehand(flat, SMALL["size"])
    before, gain = np.sqrt(fit.camera.covariance[0, 0]), next_view(fit).gain
    same = fit_freehand([*flat, views(4, SMALL, tilt=8.0)[0]], SMALL["size"])
    more = fit_freehand(
        [*flat, views(5, {**SMALL, "depth": (145.0, 175.0), "spread": 0.0}, tilt=30.0)[0]], SMALL["size"]
    )
    assert np.sqrt(more.camera.covariance[0, 0]) < 0.7 * np.sqrt(same.camera.covariance[0, 0])
    assert gain * before < 0.7 * np.sqrt(same.camera.covariance[0, 0])


def test_only_what_lies_between_the_marks_of_a_view_is_covered() -> None:
    seen = views(6, GOOD)
    left = [view for view in seen if view.pixels[:, 0].max() < 700]
    right = [view for view in seen if view.pixels[:, 0].min() > 500]
    fit = fit_freehand(seen, GOOD["size"])
    whole = coverage_of(fit)
    assert 0.3 < whole.share < 0.95
    assert whole.worst_px < 0.3
    assert whole.sigma_px[~whole.covered].max() > 2 * np.median(whole.sigma_px[whole.covered])
    assert left
    assert right
    hulls = [cv2.convexHull(view.pixels.astype(np.float32)) for view in fit.views]
    for at in np.ndindex(whole.covered.shape):
        u, v = whole.pixels[at]
        inside = max(cv2.pointPolygonTest(hull, (float(u), float(v)), False) for hull in hulls) >= 0
        assert inside == whole.covered[at]


def test_a_distortion_that_folds_between_the_marks_is_told() -> None:
    fit = fit_freehand(views(7, GOOD), GOOD["size"])
    assert not np.isfinite(folds(fit))
    assert undetermined(fit, "") == []
    reach = max(float(np.linalg.norm(v.world[:, :2] / v.world[:, 2:], axis=1).max()) for v in fit.views)
    fit.camera.distortion[:] = [-1 / (3 * (0.8 * reach) ** 2), 0.0, 0.0, 0.0, 0.0]  # the slope is 0 at 0.8 of the reach
    assert folds(fit) == pytest.approx(900.0 * 0.8 * reach * 2 / 3, rel=0.1)
    assert "folds, or may fold, the image" in undetermined(fit, "")[0]


def test_views_are_left_out_to_first_order_as_by_fitting_again() -> None:
    seen = views(8, GOOD)
    fit = fit_freehand(seen, GOOD["size"])
    foretold = fit.adjusted.left_out(fit.terms)
    for k in range(3):
        others = [v for i, v in enumerate(seen) if i != k]
        poses = np.delete(fit.adjusted.poses, k, axis=0)
        lens = adjust(others, fit.adjusted.lens, poses, fit.terms).lens
        fixed = adjust([seen[k]] * 2, lens, fit.adjusted.poses[[k, k]], fit.terms)
        assert foretold[k] >= fixed.squares[0]
        again = _pose_alone(seen[k], lens, fit.adjusted.poses[k])
        assert foretold[k] == pytest.approx(again, rel=0.02)


def _pose_alone(view: PlaneMarks, lens: np.ndarray, pose: np.ndarray) -> float:
    """Sum of squares of a view under a lens, its pose by OpenCV."""
    matrix = np.array([[lens[0], 0, lens[2]], [0, lens[1], lens[3]], [0, 0, 1]])
    points = np.column_stack([view.points, np.zeros(len(view))])
    start = (pose[:3].copy()[:, None], pose[3:].copy()[:, None])
    r, t = cv2.solvePnPRefineLM(
        points, view.pixels, matrix, lens[4:], *start, (cv2.TERM_CRITERIA_COUNT + cv2.TERM_CRITERIA_EPS, 200, 1e-14)
    )
    return float(((cv2.projectPoints(points, r, t, matrix, lens[4:])[0][:, 0] - view.pixels) ** 2).sum())


def listed(folder: Path, seen: list[PlaneMarks], size: tuple[int, int]) -> Path:
    """A session of freehand views whose marks are listed and not measured again."""
    text = 'format = 1\nunits = "mm"\n[target]\nkind = "listed"\npolarity = "light"\n'
    for view in seen:
        cv2.imwrite(str(folder / f"{view.name}.png"), np.zeros(size[::-1], np.uint8))
        with (folder / f"{view.name}.csv").open("w", newline="", encoding="utf-8") as stream:
            writer = csv.writer(stream)
            writer.writerow(["x", "y", "z", "u", "v"])
            writer.writerows([*p, 0.0, *q] for p, q in zip(view.points, view.pixels, strict=True))
        text += (
            f'[[plane]]\nname = "{view.name}"\nimages = "{view.name}.png"\npoints = "{view.name}.csv"\nrefine = false\n'
        )
    (folder / "calibration.toml").write_text(text, encoding="utf-8")
    return folder / "calibration.toml"


@pytest.mark.parametrize(("told", "status"), [(GOOD, 0), (SMALL, 3)])
def test_the_command_passes_only_what_is_determined(told: dict, status: int, tmp_path: Path) -> None:
    file = listed(tmp_path, views(9, told), told["size"])
    done = CliRunner().invoke(
        app, ["calibrate", str(file), "-o", str(tmp_path / "rig.json"), "--report", str(tmp_path / "r.html"), "--json"]
    )
    assert done.exit_code == status, done.stderr
    result = json.loads(done.stdout)
    camera = result["camera"]
    sigma = np.array([*camera["focal_sigma_px"], *camera["centre_sigma_px"], *camera["distortion_sigma"]])
    off = np.array([*camera["focal_px"], *camera["centre_px"], *camera["distortion"]]) - told["lens"]
    assert (np.abs(off) < 4 * sigma).all()
    assert result["passed"] is (status == 0)
    assert ("do not determine the focal length" in result["why"]) is (status == 3)
    page = (tmp_path / "r.html").read_text(encoding="utf-8")
    assert "covered by marks" in page
    assert "principal point" in page

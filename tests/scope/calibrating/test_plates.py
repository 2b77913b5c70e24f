"""Stripes on plates: a sheet of light that is known, seen by a pinhole that is known, on plates and beside them."""

from __future__ import annotations

import numpy as np
import pytest

from calibration.camera import Camera
from calibration.geometry import Plane, Pose
from calibration.grouping import grouped
from calibration.rays import PinholeCamera, PlaneMarks
from calibration.volume import Volume
from scope.calibrating.channels import choose
from scope.calibrating.plates import Light, Seen, common_sheet, seen_on, stripes_on

SIZE = (640, 480)
MATRIX = np.array([[600.0, 0, 320], [0, 600, 240], [0, 0, 1]])
SHEET = Plane.through(np.array([40.0, 0.0, 600.0]), np.array([0.9, 0.1, -0.42]))
GRID = np.stack(np.meshgrid(np.arange(8.0), np.arange(6.0)), axis=-1).reshape(-1, 2) * 25.0


def camera() -> Camera:
    return PinholeCamera(MATRIX, np.zeros(5), Pose.identity(), SIZE, Volume.everywhere(), np.zeros((9, 9)), 0.1)


def light(world: Plane, rng: np.random.Generator, lines: slice, noise: float = 0.1) -> Light:
    """The stripe of the sheet on a plane of the world, on some of the image's rows: rays by hand, no code of the project."""
    v = np.arange(480.0)
    normal = np.cross(SHEET.normal, world.normal)  # direction of the line in which sheet and plane meet
    point = np.linalg.solve(np.stack([SHEET.normal, world.normal, normal]), [SHEET.offset, world.offset, 0.0])
    t = (v - 240.0) / 600.0
    along = (t * point[2] - point[1]) / (normal[1] - t * normal[2])
    place = point + along[:, None] * normal
    pixels = np.column_stack([600.0 * place[:, 0] / place[:, 2] + 320.0 + rng.normal(0, noise, 480), v])
    keep = np.zeros(480, bool)
    keep[lines] = True
    pixels[~keep] = np.nan
    return Light(pixels, np.where(keep, noise, np.nan), np.where(keep, 1.5, np.nan))


def marks(name: str, pose: Pose) -> PlaneMarks:
    world = pose.apply(np.column_stack([GRID, np.zeros(len(GRID))]))
    pixels = world[:, :2] / world[:, 2:] * 600.0 + [320.0, 240.0]
    return PlaneMarks(name, pixels, GRID, pose, np.arange(len(GRID)), np.zeros((len(GRID), 2, 2)))


def view(k: int, rng: np.random.Generator, *, shift: float = 0.0, wall: bool = False) -> list[Seen]:
    """Stripes of a plate held somewhere, its marks ``shift`` mm beside the stripe; or only the light on a wall behind it."""
    turn = np.radians(rng.uniform(-20, 20, 3)) * [1, 1, 0.2]
    pose = Pose.from_rotation_vector(turn, np.array([-60.0 + shift, -60.0, 520.0 + 25.0 * k]))
    seen = marks(f"v{k}", pose)
    plane = Plane.through(pose.translation, pose.rotation[:, 2])
    if wall:
        plane = Plane.through(np.array([0.0, 0.0, 1100.0 + 40 * k]), np.array([0.1 * (k % 3), 0.1, 1.0]))
    return stripes_on(seen_on(camera(), seen, light(plane, rng, slice(150, 330))), seen, "auto")


def test_a_stripe_beside_the_marks_is_followed_and_lies_on_the_sheet():
    (stripe, *_) = view(1, np.random.default_rng(2), shift=130.0)
    assert not stripe.marked.any()
    assert len(stripe.line) > 120
    assert np.abs(SHEET.distance(stripe.points)).max() < 1.0


def test_marks_and_a_rectangle_bound_it():
    rng = np.random.default_rng(4)
    pose = Pose.from_rotation_vector(np.array([0.1, -0.2, 0.0]), np.array([-60.0, -60.0, 560.0]))
    seen, plane = marks("a", pose), Plane.through(pose.translation, pose.rotation[:, 2])
    found = seen_on(camera(), seen, light(plane, rng, slice(20, 460)))
    (inside,) = stripes_on(found, seen, "marks")
    assert inside.marked.all()
    (part, *_) = stripes_on(found, seen, (0.0, 175.0, 20.0, 60.0))
    assert 20.0 <= part.flat[:, 1].min() < part.flat[:, 1].max() <= 60.0
    assert len(part.line) < len(inside.line)


@pytest.mark.parametrize("bad", [0, 4])
def test_views_that_show_other_light_are_told_from_the_sheet_that_the_others_share(bad):
    rng = np.random.default_rng(5)
    views = [view(k, rng, shift=30.0, wall=k < bad) for k in range(10)]
    common = common_sheet(views)
    assert common is not None
    assert {f"v{k}" for k in range(bad, 10)} == set(common.chosen)
    assert abs(common.plane.normal @ SHEET.normal) > np.cos(np.radians(0.1))
    assert all(off > 20.0 for off in common.apart.values())


def test_light_that_keeps_its_pixels_while_the_plate_moves_is_no_sheet():
    """Seven of ten views show the stripe of a wall that stands still; the plane that they span goes through the camera."""
    rng = np.random.default_rng(6)
    still = light(Plane.through(np.array([0.0, 0.0, 900.0]), np.array([0.05, 0.1, 1.0])), rng, slice(150, 330))
    views = []
    for k in range(10):
        pose = Pose.from_rotation_vector(
            np.radians(rng.uniform(-20, 20, 3)), np.array([-60.0, -60.0, 520.0 + 25.0 * k])
        )
        seen = marks(f"v{k}", pose)
        views.append(view(k, rng, shift=30.0) if k < 3 else stripes_on(seen_on(camera(), seen, still), seen, "auto"))
    assert all(views)
    assert common_sheet(views[3:]) is None
    common = common_sheet(views)
    assert common is not None
    assert {f"v{k}" for k in range(3)} <= set(common.chosen)
    assert np.degrees(np.arccos(abs(common.plane.normal @ SHEET.normal))) < 0.5


def test_stripes_on_one_line_span_no_sheet():
    rng = np.random.default_rng(6)
    first = view(1, rng)
    assert common_sheet([first]) is None
    assert common_sheet([first, []]) is None


def test_the_channel_of_the_least_error_is_taken_and_the_usual_one_stays_where_it_is_as_good():
    rng = np.random.default_rng(7)
    pose = Pose.from_rotation_vector(np.zeros(3), np.array([-60.0, -60.0, 560.0]))
    plane = Plane.through(pose.translation, pose.rotation[:, 2])
    stripes = {
        noise: stripes_on(
            seen_on(camera(), marks("a", pose), light(plane, rng, slice(150, lines), noise)), marks("a", pose), "auto"
        )
        for noise, lines in ((0.05, 330), (0.1, 330), (0.055, 330), (0.052, 200))
    }
    assert choose("red", {"red": stripes[0.1][:1], "green": stripes[0.05][:1]}).channel == "green"
    assert choose("red", {"red": stripes[0.05][:1], "green": stripes[0.1][:1]}).channel == "red"
    assert choose("red", {"red": stripes[0.052][:1], "green": stripes[0.05][:1]}).channel == "green"  # more lines
    assert choose("red", {"red": [], "green": stripes[0.1][:1]}).errors["red"] == np.inf
    near = {"red": stripes[0.05][:1], "green": stripes[0.055][:1]}  # a green laser leaks into red
    assert choose("red", near, "green-excess").channel == "green"
    far = {"red": stripes[0.05][:1], "green": stripes[0.1][:1]}
    assert choose("red", far, "green-excess").channel == "red"


def test_reasons_are_counted_by_kind_and_cut_short():
    reasons = [(f"im{k}", f"no board of 6 x 8 corners ({k} found): take more") for k in range(30)] + [("x", "dark")]
    told = grouped(reasons, 40, "views")
    assert told.startswith("30 of 40 views: no board of 6 x 8 corners (0 found)")
    assert "e.g. im0" in told
    assert "1 of 40 views: dark (x)" in told
    many = [(f"im{k}", "abcdefgh" * 12 + chr(97 + k)) for k in range(20)]
    assert len(grouped(many, 20, "views")) <= 300
    assert grouped([], 3, "views") == ""

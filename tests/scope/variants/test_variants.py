"""Is it this part? Variants made on purpose are named with their size; the right part is kept."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest

from benchmarks import parts
from benchmarks.variants import PARTS, Change, made
from calibration.geometry import Pose
from scope.model import Model, Surface, features_of
from scope.model.model import prepare_model
from scope.pose import PoseResult, estimate_pose, place, pose_result
from scope.pose.estimate import PoseOptions
from scope.pose.wording import undecided_text
from scope.variants import Sight, rims_of

FEW = PoseOptions(starts=64, candidates=3)
ABOVE = Pose.from_rotation_vector([np.pi + 0.25, 0.3, 0.1], np.zeros(3)).rotation  # the camera looks on the part's z


@cache
def model(name: str) -> Model:
    return prepare_model(*PARTS[name](Change()), name=name)


@cache
def asked(name: str, kind: str, tolerance: float = 0.1, near: bool = True) -> PoseResult:
    rng = np.random.default_rng(5)
    part = made(name, kind, rng)
    assert part is not None
    middle = 0.5 * (part.vertices.min(axis=0) + part.vertices.max(axis=0))
    truth = Pose(ABOVE, np.array([2.0, 1.0, 400.0]) - ABOVE @ middle)
    cloud = parts.scan(part, truth, rng, scanner=parts.Scanner(noise=0.03, points=15_000))
    more = {"initial": truth, "options": FEW} if near else {}
    return estimate_pose(cloud, model(name), part_tolerance=tolerance, **more)  # type: ignore[arg-type]


class TestFeatures:
    def test_a_block_has_six_faces_and_twelve_convex_edges(self) -> None:
        block = parts.box_part(np.zeros(3), np.array([50.0, 40, 22]))
        found = features_of(block.vertices, block.faces)
        assert sorted(round(f.area) for f in found.faces) == [880, 880, 1100, 1100, 2000, 2000]
        assert found.rounds == ()
        assert len(found.edges.start) == 24  # each for either of its faces
        middle = np.array([25.0, 20, 11])
        assert (((found.edges.start - middle) * found.edges.out).sum(axis=1) > 0).all()

    def test_holes_and_bosses_of_the_bracket_are_the_drawn_ones(self) -> None:
        found = features_of(*PARTS["bracket"](Change()))
        drawn = {(16.0, 18.0, 6.0, True), (72.0, 30.0, 13.0, False), (72.0, 30.0, 7.0, True)}
        assert {
            (round(r.point[0], 1), round(r.point[1], 1), round(r.radius, 1), r.hollow) for r in found.rounds
        } == drawn

    def test_free_form_has_neither(self) -> None:
        made = parts.casting()
        found = features_of(made.vertices, made.faces)
        assert found.faces == ()
        assert found.rounds == ()
        assert len(found.edges.start) == 0


@pytest.mark.parametrize("short", [0.0, 0.8, -1.0])
def test_end_of_a_scan_is_measured_where_its_lattice_ends(short: float) -> None:
    """Points on the top of a block, a lattice that ends ``short`` mm before its edges, without any sensor."""
    block = parts.box_part(np.zeros(3), np.array([50.0, 40, 22]))
    surface = Surface(block.vertices, block.faces)
    x, y = np.arange(short + 0.1, 50 - short, 0.2), np.arange(short + 0.1, 40 - short, 0.2)
    top = np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)
    points = np.column_stack([top, np.full(len(top), 22.0)])
    rims = rims_of(surface, surface.features.edges, Sight(points, None, None), 1.0)
    assert len(rims.at) > 150
    assert np.median(rims.beyond) == pytest.approx(-short, abs=0.06)
    assert (np.abs(rims.out[:, 2]) < 1e-9).all()


class TestVariants:
    @pytest.mark.parametrize(("kind", "percent"), [("0.98", -2.0), ("0.99", -1.0), ("1.01", 1.0), ("1.02", 2.0)])
    @pytest.mark.long
    def test_scale_is_told_in_percent(self, kind: str, percent: float) -> None:
        found = asked("clip", kind)
        assert found.cloud_from_model is None
        assert found.variant is not None
        assert found.variant.kind == "scale"
        assert found.variant.size == pytest.approx(percent, abs=max(4 * found.variant.standard_error, 0.05))
        assert ("larger" if percent > 0 else "smaller") in found.why

    def test_one_thickness(self) -> None:
        found = asked("clip", "thickness").variant
        assert found is not None
        assert found.kind == "dimension"
        assert found.size == pytest.approx(1.0, abs=0.05)
        assert "4.00 mm" in found.text

    def test_hole_out_of_its_place(self) -> None:
        found = asked("clip", "hole").variant
        assert found is not None
        assert found.kind == "hole"
        assert found.size == pytest.approx(2.0, abs=0.3)

    def test_boss_that_is_not_there(self) -> None:
        found = asked("bracket", "boss").variant
        assert found is not None
        assert found.kind == "missing"
        assert "boss near (72, 30" in found.text
        assert found.size == pytest.approx(12.0, abs=1.0)

    def test_the_other_hand(self) -> None:
        found = asked("clip", "mirrored", near=False)
        assert found.cloud_from_model is None
        assert found.variant is not None
        assert found.variant.kind == "mirrored"
        assert np.isnan(found.variant.size)

    def test_something_more_than_the_mesh(self) -> None:
        """The bracket with its boss, asked for by the mesh without one."""
        bare = prepare_model(*PARTS["bracket"](Change(boss=False)), name="bare")
        rng = np.random.default_rng(5)
        part = made("bracket", "1.0", rng)
        assert part is not None
        truth = Pose(ABOVE, np.array([2.0, 1.0, 400.0]) - ABOVE @ np.array([50.0, 35, 29]))
        cloud = parts.scan(part, truth, rng, scanner=parts.Scanner(noise=0.03, points=15_000))
        found = estimate_pose(cloud, bare, initial=truth, options=FEW)
        assert found.cloud_from_model is None
        assert found.variant is not None
        assert found.variant.kind == "extra"
        assert found.variant.at is not None
        assert np.linalg.norm(found.variant.at[:2] - [72, 30]) < 14


class TestKept:
    @pytest.mark.parametrize("name", ["bracket", "clip", "flange", "casting"])
    def test_the_right_part_within_its_tolerance(self, name: str) -> None:
        found = asked(name, "within")
        assert found.variant is None
        assert found.cloud_from_model is not None, found.why

    def test_a_wider_tolerance_lets_the_size_pass(self) -> None:
        assert asked("clip", "0.99", 1.0).variant is None

    def test_a_tolerance_is_a_length(self) -> None:
        with pytest.raises(ValueError, match="part_tolerance"):
            asked("clip", "0.99", 0.0)


def test_json_and_words_carry_the_variant_and_what_is_undecided() -> None:
    found = asked("clip", "0.98")
    rng = np.random.default_rng(0)
    part = made("clip", "1.0", rng)
    assert part is not None
    told = pose_result(place(parts.scan(part, Pose(ABOVE, np.array([0.0, 0, 400])), rng), found, "last"))
    assert told["cloud_from_model"] is None
    assert set(told["variant"]) == {"kind", "size", "standard_error", "unit", "text", "at_mm", "alternatives"}
    assert told["variant"]["unit"] == "%"
    assert all(set(u) == {"kind", "what", "look_from"} for u in told["undecided"])


def test_what_is_out_of_sight_is_undecided_and_says_from_where_to_look() -> None:
    """From straight above neither the underside nor the lower end of a wall is seen: the web's thickness is not known."""
    rng = np.random.default_rng(0)
    part = made("clip", "1.0", rng)
    assert part is not None
    down = np.diag([1.0, -1.0, -1.0])
    truth = Pose(down, np.array([0.0, 0, 400]) - down @ np.array([24.0, 15, 13]))
    cloud = parts.scan(part, truth, rng, scanner=parts.Scanner(noise=0.03, points=15_000))
    found = estimate_pose(cloud, model("clip"), initial=truth, options=FEW)
    assert found.variant is None
    under = [u for u in found.undecided if " 4.00 mm" in u.what]
    assert len(under) == 1
    assert under[0].look_from @ [0, 0, 1.0] > 0.9
    assert "undecided here: " in "\n".join(undecided_text(found.undecided))

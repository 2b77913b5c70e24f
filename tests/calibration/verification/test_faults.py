from dataclasses import replace

import numpy as np
import pytest

from benchmarks.sessions import FIVE, FOUR, SEVEN, misplacement, session
from calibration.geometry import Pose
from calibration.rays import fit_ray_field
from calibration.verification import Lattice, find_faults
from calibration.verification import misplacement as placement
from calibration.verification.hypotheses import Choice, Hypothesis, Score
from calibration.verification.redundancy import redundancy_of

LATTICE = Lattice(10, 13, (24.0, 24.0))
CENTRE = np.array([144.0, 108.0])  # of the target, in its own coordinates


def seen(seed, stand_offs=FIVE, **options):
    """A session of 10 x 13 marks, which is quick."""
    options = {"rows": 10, "columns": 13, "pitch": 24.0, **options}
    return session(np.random.default_rng(seed), stand_offs=stand_offs, **options)


def evidence_of(planes):
    found = redundancy_of(planes, fit_ray_field(planes, orders=(3, 1)).field)
    return Score.of(found.score, found.information)


@pytest.mark.parametrize("stand_offs", [(320.0, 400.0, 480.0), FOUR, SEVEN])
@pytest.mark.parametrize("options", [{}, {"oblique": 0.5, "azimuth": 1.0}, {"target_mm": 0.05, "noise_px": 0.01}])
def test_a_clean_session_has_no_faults(stand_offs, options):
    assert find_faults(seen(1, stand_offs, **options), lattice=LATTICE) == ()


def test_planes_tilted_on_purpose_are_clean():
    tilt = misplacement("tilt", 0.15, 0.4, CENTRE)
    planes = seen(2, FOUR, true_pose={1: tilt, 3: tilt.inverse})
    for k, pose in ((1, tilt), (3, tilt.inverse)):
        planes[k] = replace(planes[k], c_from_plane=planes[k].c_from_plane @ pose)
    assert find_faults(planes) == ()


CASES = [
    ("slip", "slip", 0.08, 0.08, "mm"),
    ("rotation", "rotation", 1e-3, np.degrees(1e-3), "deg"),
    ("stand_off", "stand_off", -0.3, -0.3, "mm"),
    ("tilt", "tilt", 4e-3, np.degrees(4e-3), "deg"),
]


@pytest.mark.parametrize(("kind", "name", "size", "value", "unit"), CASES)
def test_one_misplaced_plane_is_named_and_measured(kind, name, size, value, unit):
    motion = misplacement(kind, size, 0.7, np.array([0.0, 216.0]) if kind == "rotation" else CENTRE)
    (fault,) = find_faults(seen(3, true_pose={3: motion}), lattice=LATTICE)
    assert (fault.plane, fault.kind, fault.unit) == ("w440", name, unit)
    assert abs(fault.value - value) < 3 * fault.standard_error
    assert fault.standard_error < abs(value) / 8
    assert "w440" in fault.remedy
    if kind == "rotation":  # about the lower left corner, as in figure 6
        assert np.allclose(fault.centre, [-144.0, 108.0, 440.0], atol=5.0)
    if kind == "stand_off":
        assert any(a.startswith("w440: pitch") for a in fault.alternatives)


def test_a_wrong_pitch_is_the_class_of_a_wrong_stand_off():
    (fault,) = find_faults(seen(4, true_scale={1: 1.001}))
    assert (fault.plane, fault.kind) == ("w360", "pitch")
    assert abs(fault.value - 0.1) < 3 * fault.standard_error
    assert any(a.startswith("w360: stand_off") for a in fault.alternatives)


def test_a_typing_error_of_centimetres_is_measured_exactly():
    motion = misplacement("stand_off", 30.0, 0.0, CENTRE)
    (fault,) = find_faults(seen(5, true_pose={2: motion}))
    assert (fault.plane, fault.kind) == ("w400", "stand_off")
    assert fault.value == pytest.approx(30.0, abs=4 * fault.standard_error)
    assert fault.standard_error < 0.1


def test_two_misplaced_planes_of_seven_are_both_named():
    slip, turn = misplacement("slip", 0.1, 0.3, CENTRE), misplacement("rotation", 1e-3, 0.0, CENTRE)
    faults = find_faults(seen(6, SEVEN, true_pose={1: slip, 4: turn}))
    assert {(f.plane, f.kind) for f in faults} == {("w347", "slip"), ("w427", "rotation")}


def test_with_three_planes_all_are_suspects():
    slip = misplacement("slip", 0.2, 0.0, CENTRE)
    (fault,) = find_faults(seen(7, (320.0, 400.0, 480.0), true_pose={0: slip}))
    assert fault.kind == "slip"
    suspects = {fault.plane} | {a.split(":")[0] for a in fault.alternatives if "slip" in a}
    assert suspects == {"w320", "w400", "w480"}


def test_two_planes_agree_whatever_is_wrong_with_them():
    slip = misplacement("slip", 0.5, 0.0, CENTRE)
    assert find_faults(seen(8, (320.0, 480.0), true_pose={0: slip})) == ()


def test_affine_errors_are_invisible():
    """Slips that grow linearly with depth, stand-offs all too long by a share, one wrong pitch and one turn of all."""
    turn = misplacement("rotation", 0.01, 0.0, CENTRE)
    poses = {
        k: Pose(np.eye(3), np.array([0.01 * (z - 320.0), 0.0, 0.02 * (z - 400.0)])) @ turn for k, z in enumerate(FIVE)
    }
    planes = seen(9, true_pose=poses, true_scale=dict.fromkeys(range(5), 1.01))
    assert find_faults(planes) == ()
    score_of_modes = evidence_of(planes)
    assert score_of_modes.total < len(score_of_modes.z) + 4 * np.sqrt(
        2 * len(score_of_modes.z)
    )  # nothing but noise is left


@pytest.mark.parametrize(("one", "other"), [(0, 1), (1, 2), (0, 3)])
def test_exchanged_images_are_named(one, other):
    planes = seen(10, FOUR)
    changed = list(planes)
    for a, b in ((one, other), (other, one)):
        changed[a] = replace(planes[b], name=planes[a].name, c_from_plane=planes[a].c_from_plane)
    faults = find_faults(changed, lattice=LATTICE)
    assert {(f.plane, f.kind) for f in faults} == {(planes[k].name, "swapped") for k in (one, other)}


def test_images_used_twice_are_named():
    planes = seen(11, FOUR)
    changed = [*planes[:3], replace(planes[1], name="w480", c_from_plane=planes[3].c_from_plane)]
    (fault,) = find_faults(changed)
    assert (fault.plane, fault.kind) == ("w480", "swapped")
    assert "w373" in fault.remedy


@pytest.mark.parametrize(
    ("matrix", "what"),
    [
        (((-1, 0), (0, 1)), "mirrored left to right"),
        (((1, 0), (0, -1)), "mirrored top to bottom"),
        (((-1, 0), (0, -1)), "turned by 180"),
    ],
)
def test_wrong_labels_are_named(matrix, what):
    planes = seen(12, FOUR)
    planes[2] = replace(planes[2], points=(planes[2].points - CENTRE) @ np.array(matrix).T + CENTRE)
    (fault,) = find_faults(planes, lattice=LATTICE)
    assert (fault.plane, fault.kind) == ("w427", "labelling")
    assert what in fault.remedy


def test_labels_shifted_by_a_column_are_named():
    planes = seen(13)
    planes[1] = replace(planes[1], points=planes[1].points + np.array([24.0, 0.0]), mark=planes[1].mark + 1)
    (fault,) = find_faults(planes, lattice=LATTICE)
    assert (fault.plane, fault.kind) == ("w360", "labelling")
    assert "0 rows and -1 columns" in fault.remedy


def test_single_bad_marks_are_named_and_measured_beside_a_slip():
    planes = seen(14, true_pose={2: misplacement("slip", 0.1, 0.0, CENTRE)})
    pixels = planes[4].pixels.copy()
    pixels[7] += [0.6, 0.8]
    pixels[60] += [0.0, -0.4]
    planes[4] = replace(planes[4], pixels=pixels)
    faults = find_faults(planes)
    marks = {f.mark: f for f in faults if f.kind == "mark"}
    assert set(marks) == {int(planes[4].mark[7]), int(planes[4].mark[60])}
    for row, size in ((7, 1.0), (60, 0.4)):
        fault = marks[int(planes[4].mark[row])]
        assert (fault.plane, fault.unit) == ("w480", "px")
        assert abs(fault.value - size) < 4 * fault.standard_error
    assert [(f.plane, f.kind) for f in faults if f.kind != "mark"] == [("w400", "slip")]


def test_scatter_of_all_planes_is_no_fault():
    """A jig that repeats to 10 um only, against noise of less than 1 um in the mean: nothing stands out."""
    rng = np.random.default_rng(15)
    poses = {k: Pose(np.eye(3), np.append(0.01 * rng.standard_normal(2), 0.0)) for k in range(7)}
    planes = seen(15, SEVEN, true_pose=poses, noise_px=0.01)
    assert evidence_of(planes).total > 300
    assert find_faults(planes) == ()


def test_modes_are_the_derivatives_of_the_residuals():
    planes = seen(16, noise_px=0.0, oblique=0.4)
    field = fit_ray_field(planes).field
    plane = planes[1]
    world = plane.world @ field.c_from_d
    modes = placement.modes(field, plane, placement.slopes(field, plane.pixels, world))
    across = world[:, :2]
    for mode in range(placement.MODES):
        step = 1e-5
        amounts = np.zeros(placement.MODES)
        amounts[mode] = step
        moved = placement.put_right(field, plane, amounts).world @ field.c_from_d
        slope = placement.slopes(field, plane.pixels, world)
        seen_at = moved[:, :2] - slope * (moved[:, 2:] - world[:, 2:])
        assert np.allclose((across - seen_at) / step, modes[:, :, mode], atol=2e-3)


def test_evidence_of_clean_sessions_is_chi_square():
    ratio, freedom = [], 0
    for seed in range(12):
        score_of_modes = evidence_of(seen(100 + seed, oblique=0.04 * seed, azimuth=float(seed)))
        ratio.append(score_of_modes.total)
        freedom += len(score_of_modes.z)
    spread = np.sqrt(2 * freedom)
    assert abs(sum(ratio) - freedom) < 3.5 * spread


@pytest.mark.long
def test_standard_errors_are_those_of_the_estimates():
    """Slips of one plane in 30 sessions: scatter over standard error, 60 components."""
    pulls = []
    for seed in range(30):
        score_of_modes = evidence_of(seen(200 + seed, FOUR))
        fit = score_of_modes.fit((Hypothesis(1, "slip"),))
        pulls.append(fit.amounts / np.sqrt(np.diag(fit.covariance)))
    assert np.sqrt(np.mean(np.square(pulls))) == pytest.approx(1.0, abs=0.22)


def test_one_plane_is_a_wrong_argument():
    with pytest.raises(ValueError, match="two or more"):
        find_faults(seen(17)[:1])


@pytest.mark.parametrize(("kind", "size"), [("slip", 100.0), ("stand_off", -120.0), ("rotation", 0.6), ("tilt", 0.4)])
def test_a_gross_fault_is_named_and_measured_too(kind, size):
    """Far beyond where anything is linear; slips by 100 mm once passed as planes that scatter."""
    (fault,) = find_faults(seen(20, true_pose={2: misplacement(kind, size, 0.7, CENTRE)}))
    assert (fault.plane, fault.kind) == ("w400", kind)
    true = np.degrees(size) if kind in ("rotation", "tilt") else size
    assert abs(fault.value - true) < 5 * fault.standard_error


@pytest.mark.parametrize(("kind", "size"), [("slip", 48.0), ("rotation", 0.2), ("tilt", 0.2), ("stand_off", 400.0)])
def test_a_gross_fault_among_three_planes_is_told(kind, size):
    """Once a crash of the linear algebra."""
    faults = find_faults(seen(21, (320.0, 400.0, 480.0), true_pose={2: misplacement(kind, size, 0.7, CENTRE)}))
    assert faults
    assert "w480" in {f.plane for f in faults} | {a.split(":")[0] for f in faults for a in f.alternatives}


@pytest.mark.parametrize("sizes", [(24.0, 5.0), (1.0, 0.7)])
def test_planes_that_no_few_faults_explain_do_not_pass(sizes):
    """Two slips among four planes leave open which two: that is no reason to call all four good."""
    poses = {k: misplacement("slip", size, 2.0 * k + 0.5, CENTRE) for k, size in zip((0, 2), sizes, strict=True)}
    assert find_faults(seen(22, FOUR, true_pose=poses), lattice=LATTICE)


@pytest.mark.parametrize("scale", [0.9995, 1.02])
def test_a_pitch_that_is_wrong_about_the_middle_is_one_fault(scale):
    """The grid is stretched about its own middle, as if seated there: no slip beside it."""
    middle = Pose(np.eye(3), np.append(CENTRE * (1 - scale), 0.0))
    (fault,) = find_faults(seen(23, true_pose={2: middle}, true_scale={2: scale}, oblique=0.35), lattice=LATTICE)
    assert (fault.plane, fault.kind, fault.unit) == ("w400", "pitch", "%")
    assert abs(fault.value - 100 * (scale - 1)) < 4 * fault.standard_error
    assert np.allclose(fault.centre, [0.0, 0.0, 400.0], atol=5.0)
    assert any(a.startswith("w400: stand_off") for a in fault.alternatives)


def in_order(planes, order):
    return [replace(planes[j], name=p.name, c_from_plane=p.c_from_plane) for p, j in zip(planes, order, strict=True)]


@pytest.mark.parametrize("order", [(1, 0), (1, 0, 2), (0, 2, 1), (1, 2, 0, 3, 4), (2, 0, 3, 1, 4)])
def test_images_in_any_other_order_are_named(order):
    stand_offs = {2: (320.0, 480.0), 3: (320.0, 400.0, 480.0), 5: FIVE}[len(order)]
    planes = seen(24, stand_offs)
    faults = find_faults(in_order(planes, order), lattice=LATTICE)
    assert {(f.plane, f.kind) for f in faults} == {(planes[k].name, "swapped") for k, j in enumerate(order) if k != j}


def test_stand_offs_counted_towards_the_camera_are_told():
    """They leave no residual, but everything ranged would be a mirror image."""
    (fault,) = find_faults(in_order(seen(25, FIVE), (4, 3, 2, 1, 0)), lattice=LATTICE)
    assert fault.kind == "swapped"
    assert "mirror" in fault.remedy


def test_of_two_planes_one_turned_is_called_turned():
    planes = seen(26, (320.0, 480.0))
    turned = replace(planes[1], points=2 * CENTRE - planes[1].points, mark=129 - planes[1].mark)
    (fault,) = find_faults([planes[0], turned], lattice=LATTICE)
    assert fault.kind == "labelling"
    assert "180 degrees" in fault.remedy
    assert fault.alternatives


def test_sizes_beside_a_scatter_of_the_planes_have_wider_errors():
    """Two stated standard errors cover 95 % also where the scatter comes from four differences of planes."""
    rng = np.random.default_rng(30)
    score_of_modes = Score(np.zeros(1), np.zeros((1, 49)), 7)
    scatter = np.array([1e-3] * 7)
    none = Choice((Hypothesis(2, "stand_off"),), score_of_modes, np.zeros(7))
    some = Choice((Hypothesis(2, "stand_off"),), score_of_modes, scatter)
    assert none.widening("stand_off") == 1.0
    pulls = rng.normal(size=100_000) / np.sqrt(rng.chisquare(4, 100_000) / 4)
    assert np.mean(np.abs(pulls) < 2 * some.widening("stand_off")) == pytest.approx(0.9545, abs=0.003)

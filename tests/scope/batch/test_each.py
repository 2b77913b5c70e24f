"""Laws of work on several processes: the answers do not know how many there were, and a worker that dies loses none."""

from __future__ import annotations

import os
from functools import partial
from pathlib import Path

import numpy as np
import pytest

from calibration.errors import FileError
from scope.batch import each
from scope.check import check_repeats
from scope.cloud import ScanCloud


def squared(number: int, folder: str) -> int:
    """The square; the worker that gets 3 for the first time dies."""
    mark = Path(folder, "died")
    if number == 3 and not mark.exists():
        mark.write_text("")
        os._exit(1)
    return number * number


def refused(number: int) -> int:
    raise FileError(f"item {number} is bad")


def test_one_job_is_this_process() -> None:
    seen: list[tuple[int, int]] = []
    assert each(lambda k: (k, os.getpid()), range(3), on_done=lambda *x: seen.append(x)) == [
        (k, os.getpid()) for k in range(3)
    ]
    assert seen == [(1, 3), (2, 3), (3, 3)]
    assert each(len, []) == []


@pytest.mark.long
def test_two_jobs_in_order_though_one_dies_and_an_error_stays_what_it_is(tmp_path: Path) -> None:
    pytest.importorskip("distributed")
    assert each(partial(squared, folder=str(tmp_path)), range(6), jobs=2) == [k * k for k in range(6)]
    assert (tmp_path / "died").exists()
    with pytest.raises(FileError, match="item . is bad"):
        each(refused, range(4), jobs=2)


def test_no_job_is_an_argument() -> None:
    with pytest.raises(ValueError, match="jobs must be 1 or more"):
        each(len, ["a"], jobs=0)


def test_repeats_of_a_check_on_workers_are_those_of_one_process() -> None:
    pytest.importorskip("distributed")
    scans = []
    for seed in range(3):
        rng = np.random.default_rng(seed)
        x, y = rng.uniform(-20, 20, (2, 400))
        z = 300.0 + 0.01 * rng.standard_normal(400)
        scans.append(ScanCloud.from_points(np.stack([x, y, z], axis=1)))
    here = check_repeats(scans, "plane")
    there = check_repeats(scans, "plane", each=partial(each, jobs=2))
    assert [check.error_mm for check in there.checks] == [check.error_mm for check in here.checks]
    assert there.deviation_mm == here.deviation_mm

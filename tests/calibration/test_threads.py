"""Threads are asked for, not taken: every library obeys, and one word on the command line says it to all of them."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

from calibration.threads import OWN, claim_threads, own_threads
from cli.main import threads_first

ROOT = Path(__file__).resolve().parents[2]
ASK = """
import json, sys
sys.argv = ["scope", *sys.argv[1:]]
import cli.main
loaded = sorted({"numpy", "cv2", "numba", "scipy"} & set(sys.modules))
cli.main.app = lambda: None
cli.main.main()
import numpy, scipy.linalg, cv2, numba
from threadpoolctl import threadpool_info
from calibration.threads import own_threads
pools = [pool["num_threads"] for pool in threadpool_info() if pool["internal_api"] in ("openblas", "openmp", "mkl")]
print(json.dumps([loaded, pools, cv2.getNumThreads(), numba.config.NUMBA_NUM_THREADS, own_threads(7)]))
"""


def asked(*words: str, **environment: str) -> tuple[list[str], list[int], int, int, int]:
    """What the libraries take after a command line: modules loaded too early, BLAS, OpenCV, numba, SCOPE."""
    kept = {
        k: v
        for k, v in os.environ.items()
        if not k.endswith(("_NUM_THREADS", "_THREADS", "_THREADS_NUM", "_MAXIMUM_THREADS"))
    }
    done = subprocess.run(
        [sys.executable, "-c", ASK, *words], env=kept | environment | {"PYTHONPATH": str(ROOT)}, capture_output=True, text=True, check=True, timeout=120
    )  # fmt: skip
    return tuple(json.loads(done.stdout))  # type: ignore[return-value]


@pytest.mark.parametrize(
    "words", [("--threads", "1", "scan", "c.toml"), ("scan", "c.toml", "--threads=1"), ("scan", "--threads", "1")]
)
def test_openblas_opencv_and_numba_obey(words: tuple[str, ...]) -> None:
    pytest.importorskip("threadpoolctl")
    loaded, pools, opencv, numba, own = asked(*words)
    assert loaded == []
    assert pools
    assert set(pools) == {1}
    assert (opencv, numba, own) == (1, 1, 1)


def test_matrices_take_one_thread_unless_the_user_says_otherwise() -> None:
    pytest.importorskip("threadpoolctl")
    assert set(asked("scan")[1]) == {1}
    if (os.cpu_count() or 1) > 1:
        assert max(asked("scan", OMP_NUM_THREADS="2")[1]) == 2


def test_the_environment_says_it_to_all() -> None:
    environment = {"OMP_NUM_THREADS": "8", "OPENBLAS_NUM_THREADS": "4"}
    claim_threads(None, environment)
    assert environment["OPENBLAS_NUM_THREADS"] == "4"
    assert environment["MKL_NUM_THREADS"] == "8"
    assert OWN not in environment
    claim_threads(3, environment)
    assert set(environment.values()) == {"3"}
    for wrong in (0, -1, 1025):
        with pytest.raises(ValueError, match="1 to 1024"):
            claim_threads(wrong, {})


def test_what_is_no_count_is_not_obeyed(monkeypatch: pytest.MonkeyPatch) -> None:
    for text, count in (("", 5), ("2", 2), ("x", 5), ("0", 5)):
        monkeypatch.setenv(OWN, text)
        assert own_threads(5) == count


@pytest.mark.parametrize(
    ("before", "after"),
    [
        (["scan", "a", "--threads", "2", "-q"], ["--threads", "2", "scan", "a", "-q"]),
        (["scan", "--threads=2"], ["--threads=2", "scan"]),
        (["scan", "--", "--threads"], ["scan", "--", "--threads"]),
        (["scan", "--threads"], ["--threads", "scan"]),
        (["scan"], ["scan"]),
    ],
)
def test_the_word_may_stand_anywhere(before: list[str], after: list[str]) -> None:
    assert threads_first(["scope", *before]) == ["scope", *after]

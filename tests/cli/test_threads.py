"""Laws of how a command behaves beside others on a busy machine."""

from __future__ import annotations

import os
import subprocess
import sys

import pytest

CODE = """
import os, sys
from cli.main import main
sys.argv = ["scope", "--version"]
try:
    main()
finally:
    print("numpy" in sys.modules, os.environ["OPENBLAS_NUM_THREADS"], file=sys.stderr)
"""


@pytest.mark.parametrize(("given", "taken"), [(None, "1"), ("3", "3")])
def test_linear_algebra_has_one_thread_unless_the_user_says_otherwise(given: str | None, taken: str) -> None:
    asked = ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS")  # either says what the user wants
    around = {name: value for name, value in os.environ.items() if name not in asked}
    around |= {} if given is None else {"OPENBLAS_NUM_THREADS": given}
    ran = subprocess.run([sys.executable, "-c", CODE], env=around, capture_output=True, text=True, check=False)
    assert ran.stderr.split() == ["False", taken]  # numpy, which reads it once, comes later

"""Compiled functions, whose machine code is kept on disk where a folder for it can be written. Importing it loads numba."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, TypeVar

import numba

Kernel = TypeVar("Kernel", bound=Callable[..., Any])

FAST = {"contract", "reassoc", "nsz", "arcp"}  # never nnan: NaN is an answer


def cached(**options: Any) -> Callable[[Kernel], Kernel]:
    """Decorator: compile with these options of numba, and keep the machine code; without a place for it, compile anew."""

    def decorate(function: Kernel) -> Kernel:
        try:
            return numba.njit(function, cache=True, **options)  # type: ignore[no-any-return]
        except RuntimeError:  # numba found no folder that it may write to
            return numba.njit(function, **options)  # type: ignore[no-any-return]

    return decorate


def compiled(function: Kernel) -> Kernel:
    """Compile without the interpreter lock, with fast arithmetic to which NaN stays NaN."""
    return cached(nogil=True, fastmath=FAST, error_model="numpy")(function)

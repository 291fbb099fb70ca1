"""Compilation of the kernels by numba, and their cache."""

from __future__ import annotations

from collections.abc import Callable
from functools import wraps
from typing import Any, TypeVar, cast

import numba
import numpy as np
from numba import types
from numba.np.numpy_support import as_dtype
from numpy.typing import NDArray

Ints = NDArray[np.int64]
Bools = NDArray[np.bool_]
Loop = TypeVar("Loop", bound=Callable[..., Any])

number, single, integer, flag = types.float64, types.float32, types.int64, types.boolean


def given(element: Any, dimensions: int) -> Any:
    """Type of a C-contiguous read-only array."""
    return types.Array(element, dimensions, "C", readonly=True)


numbers, pairs, matrices = given(number, 1), given(number, 2), given(number, 3)
integers, flags = given(integer, 1), given(flag, 1)
single_pairs, words = given(types.float32, 2), given(types.uint64, 2)
images, patches = given(types.uint8, 2), given(types.uint8, 3)


cache_errors: list[str] = []
"""Reasons why kernels could not be cached or loaded; each start then compiles them."""


def compiled(*arguments: Any) -> Callable[[Loop], Loop]:
    """Compile a kernel for these argument types on import; division by zero gives inf or nan.

    Arrays of other layouts or types are copied.
    """
    kinds = [as_dtype(a.dtype) if isinstance(a, types.Array) else None for a in arguments]

    def compile_loop(loop: Loop) -> Loop:
        try:
            done: Any = numba.njit(arguments, nogil=True, cache=True, error_model="numpy")(loop)
        except Exception as error:  # disk full or corrupt file; other errors recur below
            cache_errors.append(f"{loop.__name__}: {error}")
            done = numba.njit(arguments, nogil=True, error_model="numpy")(loop)

        @wraps(loop)
        def call(*values: Any) -> Any:
            return done(
                *[
                    value if kind is None else np.ascontiguousarray(value, kind)
                    for value, kind in zip(values, kinds, strict=True)
                ]
            )

        return cast(Loop, call)

    return compile_loop


def part(loop: Loop) -> Loop:
    """Compile a function that only kernels of the same file call."""
    done: Any = numba.njit(nogil=True, error_model="numpy")(loop)
    return cast(Loop, done)

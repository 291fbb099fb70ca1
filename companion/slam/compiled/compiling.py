"""How the loops are compiled and kept."""

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
    """The type of an array in rows, which a loop only reads."""
    return types.Array(element, dimensions, "C", readonly=True)


numbers, pairs, matrices = given(number, 1), given(number, 2), given(number, 3)
integers, flags = given(integer, 1), given(flag, 1)
places, words = given(types.float32, 2), given(types.uint64, 2)
images, patches = given(types.uint8, 2), given(types.uint8, 3)


not_kept: list[str] = []
"""Why loops could not be kept on disk or taken from there, in words; each start compiles them."""


def compiled(*arguments: Any) -> Callable[[Loop], Loop]:
    """Compile a loop for these types of arguments, at once; a division by zero gives inf or nan.

    Arrays that it is given may lie otherwise in memory, which costs a copy.
    """
    kinds = [as_dtype(a.dtype) if isinstance(a, types.Array) else None for a in arguments]

    def compile_loop(loop: Loop) -> Loop:
        try:
            done: Any = numba.njit(arguments, nogil=True, cache=True, error_model="numpy")(loop)
        except Exception as error:  # no room, or a damaged file; what else it is comes up again
            not_kept.append(f"{loop.__name__}: {error}")
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
    """What only compiled loops of the same file call."""
    done: Any = numba.njit(nogil=True, error_model="numpy")(loop)
    return cast(Loop, done)

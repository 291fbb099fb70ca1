"""Compilation of the kernels by numba, and what spares it: code of the package, numba's cache.

What is in neither is compiled by a copy of this process that ends with it, because LLVM gives none
of its memory back, 135 to 330 MB. A process with several threads cannot be copied, and compiles.
"""

from __future__ import annotations

import functools
import importlib
import os
import pickle
import pkgutil
import sys
import traceback
from collections.abc import Callable, Sequence
from functools import wraps
from typing import Any, NoReturn, TypeVar, cast

import llvmlite
import numba
import numpy as np
from numba import types
from numba.core.caching import CompileResultCacheImpl, FunctionCache, NullCache
from numba.core.compiler import CompileResult
from numba.core.runtime.nrt import rtsys
from numba.np.numpy_support import as_dtype
from numpy.typing import NDArray

from companion.slam import compiled as package
from companion.slam.compiled.shipped_code import FOLDER, ShippedCode, circumstances

Ints = NDArray[np.signedinteger[Any]]
Bools = NDArray[np.bool_]
Loop = TypeVar("Loop", bound=Callable[..., Any])

number, single, integer, flag = types.float64, types.float32, types.int64, types.boolean


def given(element: Any, dimensions: int) -> Any:
    """Type of a C-contiguous read-only array."""
    return types.Array(element, dimensions, "C", readonly=True)


numbers, pairs, matrices = given(number, 1), given(number, 2), given(number, 3)
integers, tables, flags = given(integer, 1), given(integer, 2), given(flag, 1)
large_word, half_word, small_integer = types.uint64, types.uint32, types.int32
tiny_word = types.uint8
single_pairs, words = given(types.float32, 2), given(large_word, 2)
images, patches = given(types.uint8, 2), given(types.uint8, 3)
tiny_words_out, pairs_out = types.Array(types.uint8, 1, "C"), types.Array(number, 2, "C")
"""Changed by the kernel; to be contiguous, as a copy would be changed instead."""


cache_errors: list[str] = []
"""Reasons why kernels could not be cached or loaded; each start then compiles them."""
HERE = circumstances(numba.__version__, llvmlite.__version__)
"""All that machine code depends on besides the processor."""
shipped = ShippedCode(FOLDER, HERE)
OPTIONS: dict[str, Any] = {"nogil": True, "error_model": "numpy"}
WITHOUT_LOOPS = ("compiling", "ship", "shipped_code")
"""Modules of the package that define none."""
COMPILES = "companion: loops are compiled for this processor, once: this takes a minute or two"
may_copy = True
"""False where this process is to compile by itself."""
_loops: dict[str, Any] = {}
"""Compiled loops, by `module.name`."""


def compiled(*arguments: Any) -> Callable[[Loop], Loop]:
    """Compile a kernel for these argument types on import; division by zero gives inf or nan.

    Arrays of other layouts or types are copied.
    """
    kinds = [as_dtype(a.dtype) if isinstance(a, types.Array) else None for a in arguments]

    def compile_loop(loop: Loop) -> Loop:
        name = f"{loop.__module__.rpartition('.')[2]}.{loop.__name__}"
        code = shipped.of(name)
        done = _compiled(loop, arguments) if code is None else _loaded(loop, arguments, code)
        _loops[name] = done

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
    done: Any = numba.njit(**OPTIONS)(loop)
    return cast(Loop, done)


def code_of_loops() -> dict[str, bytes]:
    """Machine code of all loops that were imported, by `module.name`."""
    return {
        name: pickle.dumps([done.overloads[kinds]._reduce() for kinds in done.overloads])
        for name, done in _loops.items()
    }


def _rebuilt(target_context: Any, parts: Sequence[Any]) -> Any:
    """A loop from its parts; of its bitcode only the name that it is entered by is left.

    Half of the time to load it is parsing the rest, which is for other loops to include it in their
    own code: none does.
    """
    (name, kind, (code, _bitcode)), of_loop, *others = parts
    entry = f'define void @"{of_loop.llvm_cpython_wrapper_name}"() {{ ret void }}'
    bitcode = llvmlite.binding.parse_assembly(entry).as_bitcode()
    compiled: Any = CompileResult
    return compiled._rebuild(target_context, (name, kind, (code, bitcode)), of_loop, *others)


class _WithoutBitcode(CompileResultCacheImpl):
    def rebuild(self, target_context: Any, payload: Sequence[Any]) -> Any:
        return _rebuilt(target_context, payload)


class _NumbaCache(FunctionCache):
    """Numba's cache; loads without what compiling alone needs, which takes a tenth of a second."""

    _impl_class = _WithoutBitcode

    def __init__(self, loop: Callable[..., Any]) -> None:
        super().__init__(loop)  # type: ignore[no-untyped-call]
        self._is_of_package = loop.__module__.startswith(f"{package.__name__}.")

    def load_overload(self, sig: Any, target_context: Any) -> Any:
        rtsys.initialize(target_context)
        found = self._kept(sig, target_context)
        if found is None and self._is_of_package and _compiled_by_a_copy():
            found = self._kept(sig, target_context)
        if found is None:
            target_context.refresh()
        return found

    def _kept(self, sig: Any, target_context: Any) -> Any:
        cache: Any = super()
        with cache._guard_against_spurious_io_errors():
            return cache._load_overload(sig, target_context)


@functools.cache
def _compiled_by_a_copy() -> bool:
    """Have a copy of this process compile all loops into the cache, once; True where it has."""
    if not may_copy or len(os.listdir("/proc/self/task")) > 1:
        return False
    print(COMPILES, file=sys.stderr, flush=True)
    pid = os.fork()
    if pid == 0:
        _compile_all()
    return os.waitpid(pid, 0)[1] == 0


def _compile_all() -> NoReturn:
    """Import all modules of the package anew, then end."""
    global may_copy
    may_copy, status = False, 1
    try:
        for module in pkgutil.iter_modules(package.__path__):
            if module.name not in WITHOUT_LOOPS:
                name = f"{package.__name__}.{module.name}"
                sys.modules.pop(name, None)
                importlib.import_module(name)
        status = int(bool(cache_errors))
    except BaseException:
        traceback.print_exc()
    finally:
        sys.stderr.flush()
        os._exit(status)


class _Given(NullCache):
    """A cache of the one loop whose code is given."""

    def __init__(self, code: bytes) -> None:
        self._code = code

    def load_overload(self, sig: Any, target_context: Any) -> Any:
        rtsys.initialize(target_context)
        (parts,) = pickle.loads(self._code)
        return _rebuilt(target_context, parts)


def _through(cache: Any, loop: Loop, arguments: tuple[Any, ...]) -> Any:
    """The loop from a cache, or compiled and put there."""
    done: Any = numba.njit(**OPTIONS)(loop)
    done._cache = cache
    done.compile(arguments)
    done.disable_compile()
    return done


def _compiled(loop: Loop, arguments: tuple[Any, ...]) -> Any:
    try:
        cache: Any = _NumbaCache
        return _through(cache(loop), loop, arguments)
    except Exception as error:  # disk full or corrupt file; other errors recur below
        cache_errors.append(f"{loop.__name__}: {error}")
        return numba.njit(arguments, **OPTIONS)(loop)


def _loaded(loop: Loop, arguments: tuple[Any, ...], code: bytes) -> Any:
    try:
        return _through(_Given(code), loop, arguments)
    except Exception as error:  # a damaged file
        shipped.why_unfit = f"{loop.__name__}: {type(error).__name__}: {error}"
        return _compiled(loop, arguments)

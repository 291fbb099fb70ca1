"""Numba kernels for per-frame work on hundreds of points.

They release the interpreter lock, so that tracking and mapping run in parallel. They are compiled
on import, before any flight, and cached on disk. A kernel calls only functions of its own file,
because the cache of a file is invalidated by changes of that file alone.
"""

"""Imports of localisation that the first pose does not need: a third of what it would wait for.

Functions that use them import them; here they are imported beside the first frames, so that none of
those later waits for that.
"""

from __future__ import annotations

import importlib
import threading

from companion.timing.clock import wait_s

LATER = ("scipy.linalg", "scipy.spatial", "scipy.sparse.linalg", "scipy.sparse.csgraph")
AFTER_S = 2.0
"""After a restart in flight poses have been proven by then."""


def import_later() -> threading.Thread:
    """Import them in a while, in a thread of their own, which is returned."""
    thread = threading.Thread(target=_import, name="imports", daemon=True)
    thread.start()
    return thread


def _import() -> None:
    wait_s(threading.Event(), AFTER_S)
    for name in LATER:
        importlib.import_module(name)

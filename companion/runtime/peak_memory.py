"""Peak memory of this process, for reports and benchmarks."""

from __future__ import annotations

import resource


def peak_memory_mb() -> float:
    """Peak memory of this process and the largest of its children that have ended, MB."""
    whose = resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN
    return sum(resource.getrusage(each).ru_maxrss for each in whose) / 1024.0

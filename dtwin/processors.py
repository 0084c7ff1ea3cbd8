"""How many processors there are to work with."""

import os


def processors() -> int:
    """Return how many processors this process may use."""
    # Only Linux says which ones a process is held to.
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1

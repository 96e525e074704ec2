"""Monte Carlo studies: the same trial for many seeds, on any executor, with the same bits.

A trial is a function of one seed. `run` calls it for every seed, on this machine's cores or on any
``concurrent.futures.Executor``. `store` keeps a long study's metrics in a CSV file, each trial as
soon as it is done, and continues where it was stopped; `check` compares a later run with it.
"""

from .checking import check, example, script
from .files import Stored, fingerprint, load, merge, store, stored
from .running import Failure, Study, StudyError, run, spawn

__all__ = [
    "Failure",
    "Stored",
    "Study",
    "StudyError",
    "check",
    "example",
    "fingerprint",
    "load",
    "merge",
    "run",
    "script",
    "spawn",
    "store",
    "stored",
]

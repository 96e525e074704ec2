"""Monte Carlo studies: the same trial for many seeds, on any executor, with the same bits.

A trial is a function of one seed. `run` calls it for every seed, on this machine's cores or on any
``concurrent.futures.Executor``, and keeps what was done when a trial raises, a worker dies or the
user presses Ctrl-C. `store`, `load` and `check` keep a long study's metrics in a CSV file that a
later run can be compared with.
"""

from .checking import check
from .files import Stored, load, store, stored
from .running import run
from .scripts import script
from .seeds import spawn
from .sources import fingerprint
from .study import Failure, Study, StudyError, StudyInterrupted

__all__ = [  # fmt: skip
    "Failure", "Stored", "Study", "StudyError", "StudyInterrupted", "check", "fingerprint", "load",
    "run", "script", "spawn", "store", "stored",
]

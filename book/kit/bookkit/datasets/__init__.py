"""Logs of robots as their authors publish them, as one table of events.

`read_utias`, `read_pyfg` and `read_bag` read the three formats, `locate` finds the files, and
`write_utias` and `write_pyfg` generate small sets in the first two formats. The files are the
reader's own: nothing of them belongs to this repository.
"""

from .bag import read_bag
from .generate import Defects, write_pyfg, write_utias
from .pyfg import read_pyfg
from .table import DataError, Dataset, locate
from .utias import read_utias

__all__ = [
    "DataError",
    "Dataset",
    "Defects",
    "locate",
    "read_bag",
    "read_pyfg",
    "read_utias",
    "write_pyfg",
    "write_utias",
]

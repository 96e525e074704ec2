"""Logs of robots as their authors publish them, as one table of events.

`read_utias`, `read_pyfg` and `read_bag` read the three formats, `locate` finds the files, and
`write_utias` and `write_pyfg` generate small sets in the first two formats. The files are the
reader's own: nothing of them belongs to this repository. `make_sensors`, `list_observations` and
`list_places` lead from a log to a filter, `follow_sightings` runs one, and `score_poses` and
`score_landmarks` lead from its estimates to their errors.
"""

from .bag import read_bag
from .generate import Defects, write_pyfg, write_utias
from .problem import (
    follow_sightings,
    list_observations,
    list_places,
    make_sensors,
    score_landmarks,
    score_poses,
)
from .pyfg import read_pyfg
from .table import DataError, Dataset, locate
from .utias import read_utias

__all__ = [
    "DataError",
    "Dataset",
    "Defects",
    "follow_sightings",
    "list_observations",
    "list_places",
    "locate",
    "make_sensors",
    "read_bag",
    "read_pyfg",
    "read_utias",
    "score_landmarks",
    "score_poses",
    "write_pyfg",
    "write_utias",
]

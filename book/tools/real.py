"""Run the programs of chapter 14 on published files, and store the errors in data/real.

    python book/tools/real.py [--tune] [NAME ...]

The files are the reader's own, in the folder that the environment variable ``DISTFILT_DATA`` names.
Rows of sets that are not there, or not named, stay as they are stored. ``--tune`` also stores the
log-likelihoods of the candidates on the first set, from which the study's `TUNED` was written.
"""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import pandas as pd

from bookkit import studies
from common import ROOT

real: Any = studies.script("_real")
FOLDER = ROOT / "data" / "real"


def store(path: Path, keys: list[str], rows: list[dict[str, Any]]) -> None:
    """Write rows into a table, of results by set in place of stored ones with the same keys."""
    frame = pd.DataFrame(rows).set_index(keys)
    if path.is_file() and "set" in keys:
        stored = pd.read_csv(path, index_col=keys)
        kept = stored[~stored.index.isin(frame.index)]
        frame = pd.concat([kept, frame])
    # Six digits, as in the stored studies
    frame.to_csv(path, float_format="%.6g")
    print(f"{path.relative_to(ROOT)}: {len(rows)} rows")


def main(arguments: list[str]) -> int:
    """Run all sets that are there, and are named if any is."""
    names = [*real.LANDMARK_SETS, *real.RADIO_SETS]
    tune = "--tune" in arguments
    arguments = [name for name in arguments if name != "--tune"]
    unknown = sorted(set(arguments) - set(names))
    if unknown:
        print(f"{', '.join(unknown)}: no such set; there are {', '.join(names)}")
        return 1
    FOLDER.mkdir(exist_ok=True)
    for name in arguments or names:
        data = real.read(name)
        if data is None:
            print(f"{name}: not in the folder DISTFILT_DATA")
            continue
        if name in real.RADIO_SETS:
            rows = real.run_radio_set(name, data)
            store(FOLDER / "radios.csv", ["set", "way"], rows)
            continue
        if tune and name == real.LANDMARK_SETS[0]:
            tuning = real.tune(data.before(real.TUNING_SECONDS))
            store(FOLDER / "tuning.csv", ["parameter", "candidate"], tuning)
        if name == real.LANDMARK_SETS[0]:
            gaps = real.compare_with_truth(data)
            store(FOLDER / "sightings.csv", ["robot"], gaps)
        rows = real.run_landmark_set(name, data)
        store(FOLDER / "landmarks.csv", ["set", "way"], rows)
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))

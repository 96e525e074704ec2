"""Robots with odometry and radios: from a file of ranges to a table of errors."""

import sys
from typing import Any

import pandas as pd

from bookkit import datasets
from distfilt.filters import GaussianFilter, Observation
from distfilt.models import Model, planar_odometry
from distfilt.network import covariance_intersection, graphs, naive_fusion

DRIFT = (0.045, 0.015)  # of odometry, in m and rad, after a second
RANGE_STD = 0.15  # in m


def make_model(data: datasets.Dataset) -> Model:
    """Return the model of all robots' poses, which their odometry drives."""
    return planar_odometry(*data.body_rates(), sigma=DRIFT)


def list_ranges(data: datasets.Dataset) -> list[Observation]:
    """Return the ranges between robots, and those to surveyed anchors."""
    anchors = data.of_kind("survey").set_index("subject")
    return datasets.list_observations(data, "range", RANGE_STD, anchors=anchors)


RULES: dict[str, dict[str, Any]] = {
    "no communication": {"share_observations": False},
    "naive fusion": {"share_observations": False, "fusion": naive_fusion},
    "intersection": {
        "share_observations": False,
        "fusion": covariance_intersection,
    },
    "all observations": {"share_observations": True},
}

if __name__ == "__main__":
    data = datasets.read_pyfg(sys.argv[1])
    n = len(data.robots)
    model, ranges = make_model(data), list_ranges(data)
    errors = {}
    for name, options in RULES.items():
        f = GaussianFilter(model, [None] * n, graphs.complete(n), **options)
        run = f.run(f.start(data.prior_poses()), None, ranges)
        estimates = (run[part].values for part in ("time", "mean", "covariance"))
        errors[name] = datasets.score_poses(data, *estimates).mean()
    table = pd.DataFrame(errors).T
    table[["position", "heading"]] **= 0.5
    print(table.round(3).to_string())

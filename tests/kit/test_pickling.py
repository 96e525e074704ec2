"""Validated functions travel to the workers of a study."""

import pickle

import cloudpickle
import numpy as np

from distfilt.updates import enkf, with_inflation
from distfilt.validation import decorators


def test_wrapper_made_inside_a_function_is_pickled() -> None:
    # `with_inflation` returns a function that no module knows by name, so that cloudpickle sends
    # its code and its globals.
    update = with_inflation(enkf, factor=1.1)
    copy = pickle.loads(cloudpickle.dumps(update))
    x = np.random.default_rng(0).standard_normal((5, 2))
    # Equal draws, so equal numbers if the copy is the same function
    results = [
        f(x, x[:, :1], [0.5], [[1.0]], rng=np.random.default_rng(1))
        for f in (update, copy)
    ]
    assert np.array_equal(*results)


def test_flag_of_nested_calls_is_the_same_object_after_pickling() -> None:
    # A second flag in a worker would let validated functions check each other's arguments again.
    flag = decorators._NESTED
    assert pickle.loads(cloudpickle.dumps(flag)) is flag

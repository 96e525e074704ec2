"""The account."""

from __future__ import annotations

import numpy as np

from distfilt.network import Ledger
from tests.network.helpers import star

BAD_INPUT = {"distfilt.network.ledger.Ledger": [("agents", lambda: Ledger.empty(0))]}


def test_a_ledger_is_replaced_never_changed() -> None:
    before = Ledger.empty(3)
    channel = star(ledger=before)
    channel.exchange([np.zeros(1)] * 3)
    channel.combine(np.zeros((3, 1)), np.eye(3))
    assert before.rounds == 0 and (before.messages == 0).all()
    assert channel.ledger.rounds == 2 and channel.ledger.messages.sum() == 8


def test_charges_add_up() -> None:
    first = Ledger.empty(2).charge(np.array([2, 1]), 3, 24)
    second = first.charge(np.array([1, 0]), np.array([5, 9]), 7, lost=0.5, rounds=4)
    assert second.rounds == 5
    assert (second.messages == [3, 1]).all() and (second.scalars == [11, 3]).all()
    assert (second.bytes == [55, 24]).all() and (second.lost == 0.5).all()
    assert repr(second) == "Ledger(rounds=5, messages=4, scalars=14, bytes=79, lost=1)"

"""The numbers in the solutions of the course, computed again."""

from __future__ import annotations

import re

import numpy as np
import pytest

from common import BOOK

TEXT = (BOOK / "course" / "solutions.md").read_text(encoding="utf-8")
PROBLEMS = (BOOK / "course.md").read_text(encoding="utf-8")


def printed(week: int) -> list[float]:
    """Return the numbers in bold of a week's solution."""
    part = TEXT.split(f"**Week {week}.**")[1].split("**Week")[0]
    return [float(number) for number in re.findall(r"\*\*([\d.]+)\*\*", part)]


def gaussian_update(prior_var: float, variances: list[float], values: list[float]):
    """Return variance and mean after independent measurements of a scalar."""
    # 1/P = 1/P₀ + Σ 1/R and m = P Σ y/R, as the prior's mean is zero
    precision = 1 / prior_var + sum(1 / v for v in variances)
    weighted = [y / v for y, v in zip(values, variances, strict=True)]
    return [1 / precision, sum(weighted) / precision]


def week_1() -> list[float]:
    after_a = gaussian_update(4, [1], [2])
    after_b = gaussian_update(4, [4], [1])
    after_both = gaussian_update(4, [1, 4], [2, 1])
    return after_a + after_b + after_both


def week_2() -> list[float]:
    points = np.linspace(0, 4, 400_001)
    # log N(x; 0, 1) + log N(4; x², 1), up to a constant
    log_density = -(points**2) / 2 - (4 - points**2) ** 2 / 2
    mode = points[np.argmax(log_density)]
    return [0, 1, mode]


def steady_forecast_variance(noise: float) -> float:
    """Iterate the Riccati recursion with Q = 1."""
    variance = 1.0
    for _ in range(500):
        variance = variance - variance**2 / (variance + noise) + 1
    return variance


def week_3() -> list[float]:
    right = steady_forecast_variance(2)
    reported = steady_forecast_variance(4)
    gain = reported / (reported + 4)
    actual = 1.0
    for _ in range(500):
        # (1 - K)² P + K² R + Q, for any gain
        actual = (1 - gain) ** 2 * actual + gain**2 * 2 + 1
    first = [right, right / (right + 2), right + 2]
    second = [reported, gain, reported + 4, actual]
    return [*first, *second, (actual + 2) / (reported + 4)]


def week_4() -> list[float]:
    laplacian = np.diag([1, 2, 2, 1]) - np.eye(4, k=1) - np.eye(4, k=-1)
    values = np.linalg.eigvalsh(laplacian)
    gains = np.linspace(0.01, 1, 100)
    factors = np.abs(1 - gains[:, None] * values[1:]).max(axis=1)
    return [*values[1:], gains[np.argmin(factors)], factors.min()]


def week_5() -> list[float]:
    return [0.5, 1, 2.0**-10]


def week_6() -> list[float]:
    joint = np.array([[2.0, 1.0], [1.0, 1.0]])
    # E[y | x] = K x with K = P_xy / P_xx, and var(y | x) = P_yy - P_xy² / P_xx
    slope = joint[0, 1] / joint[0, 0]
    conditional_var = joint[1, 1] - joint[0, 1] ** 2 / joint[0, 0]
    return [slope, conditional_var]


def week_7() -> list[float]:
    separate = np.sqrt(1 / 100 + 1 / 100)
    difference = np.sqrt(1 + 1 - 2 * 0.9)
    paired = difference / 10
    return [separate, 0.2 / separate, difference, paired, 0.2 / paired]


def week_8() -> list[float]:
    members = np.array([0.0, 1.0])
    weights = np.array([0.25, 0.75])
    # Rows are members, columns are targets; moving costs the squared distance.
    plan = np.array([[0.25, 0.0], [0.25, 0.5]])
    moved = 2 * plan.T @ members
    spread = weights @ (members - weights @ members) ** 2
    return [*moved, moved.mean(), moved.var(), spread]


def week_9() -> list[float]:
    roots = np.sqrt([0.25, 0.75])
    return [*(roots / roots.sum()), 2, roots.sum()]


def week_11() -> list[float]:
    widths = np.linspace(0.05, 0.6, 550_001)
    bias = 0.5 * widths**2 * -0.4
    variance = 0.4 / (2 * np.sqrt(np.pi) * 1000 * widths)
    return [widths[np.argmin(bias**2 + variance)]]


def count_flooded(send_back: bool) -> int:
    """Count the numbers sent while eight agents on a ring flood two numbers each."""
    messages = 0
    for source in range(8):
        senders: dict[int, set[int]] = {source: set()}
        known = {source}
        while senders:
            received: dict[int, set[int]] = {}
            for agent, origins in senders.items():
                for neighbour in ((agent + 1) % 8, (agent - 1) % 8):
                    if neighbour in origins and not send_back:
                        continue
                    messages += 1
                    received.setdefault(neighbour, set()).add(agent)
            senders = {a: o for a, o in received.items() if a not in known}
            known |= set(senders)
    return 2 * messages


def week_12() -> list[float]:
    return [count_flooded(True), count_flooded(False)]


WEEKS = {
    1: week_1,
    2: week_2,
    3: week_3,
    4: week_4,
    5: week_5,
    6: week_6,
    7: week_7,
    8: week_8,
    9: week_9,
    11: week_11,
    12: week_12,
}


@pytest.mark.parametrize("week", WEEKS)
def test_solutions_have_the_right_numbers(week):
    found = printed(week)
    np.testing.assert_allclose(found, WEEKS[week](), rtol=5e-4, atol=1e-9)


def test_every_week_has_a_problem_and_a_solution():
    for week in range(1, 13):
        assert f"**Week {week}.**" in PROBLEMS
        assert f"**Week {week}.**" in TEXT

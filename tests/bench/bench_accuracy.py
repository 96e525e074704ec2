"""Errors on DAPPER's own Lorenz-63 problem, beside those of its own filters, tuned as it says.

Truths and observations are DAPPER's (Sakov et al. 2012: three components seen every 25
steps of 0.01), and both libraries get the same. Ours have the same members and
inflation. The error is the root mean square over components, its mean over the times
after the burn-in, and over independent runs. A track is lost if its error ever exceeds
four standard deviations of an observation; such runs are counted, and left out of all
columns but `ratio_of_all`. Misses where the ratio is above its limit by more than two
standard errors of the paired difference, or tracks are lost more often by as many.
"""

from __future__ import annotations

from collections.abc import Iterator
from functools import partial
from typing import Any

import numpy as np
from _bench import Row, main, peer, table

from distfilt.filters import EnsembleFilter, ParticleFilter
from distfilt.models import lorenz63
from distfilt.sensors import component
from distfilt.updates import enkf, enkf_exact, etkf, with_inflation

RUNS = 72
END = 216.0
STD = 2**0.5


def pairs(da: Any) -> Iterator[tuple[str, Any, Any, float]]:
    """Each filter of ours, DAPPER's with the options that it recommends, the limit of the ratio."""
    problem = lorenz63(step=0.01), [component([0, 1, 2], std=STD)]
    ours = partial(EnsembleFilter, *problem, members=10)
    wider = partial(with_inflation, factor=1.02)
    centred = with_inflation(partial(enkf, centred=True), factor=1.04)
    # DAPPER's square-root filter is the reference for both deterministic updates.
    rotated = partial(da.EnKF, "Sqrt", N=10, infl=1.02, rot=True)
    yield (
        "centred draws",
        ours(update=centred),
        partial(da.EnKF, "PertObs", N=10, infl=1.04),
        1.05,
    )
    yield "square root", ours(update=wider(etkf)), rotated, 1.0
    yield "exact draws", ours(update=wider(enkf_exact)), rotated, 1.0
    particles = partial(da.PartFilt, N=800, reg=0.9, NER=0.2)
    yield (
        "particles",
        ParticleFilter(*problem, members=800, ess_threshold=0.2),
        particles,
        1.03,
    )


@table("accuracy", "numpy", "scipy", "dapper")
def errors() -> Iterator[Row]:
    parts = "", ".da_methods", ".mods.Lorenz63.sakov2012"
    dapper, da, problem = (peer(f"dapper{part}") for part in parts)
    if problem is None:
        return
    hmm = problem.HMM.copy()
    hmm.tseq.T = END
    times = hmm.tseq.tto
    dapper.set_seed(3000)
    draws = [hmm.simulate() for _ in range(RUNS)]
    truth = np.stack([x[hmm.tseq.kko] for x, _ in draws], axis=1)
    series = [np.array([*y]) for _, y in draws]
    seen = np.stack(series, axis=1)

    # Root mean square over components after the burn-in, (T, runs)
    def error(means: Any) -> Any:
        gap = (np.asarray(means) - truth)[times > hmm.tseq.BurnIn]
        return np.sqrt((gap**2).mean(axis=-1))

    for name, filter_, make, limit in pairs(da):
        state = filter_.start(
            (problem.x0, 2 * np.eye(3)), rng=np.random.default_rng(5), runs=(RUNS,)
        )
        ours = error(filter_.run(state, times, [seen])["mean"][:, :, 0])
        dapper.set_seed(9000)
        means = []
        for x, y in draws:
            other = make()
            other.assimilate(hmm, x, y, liveplots=False)
            means.append(other.stats.mu.a)
        theirs = error(np.stack(means, axis=1))
        ratio_of_all = ours.mean() / theirs.mean()
        # Runs in which either filter has lost the track would dominate the averages.
        lost = (ours > 4 * STD).any(axis=0)
        lost_theirs = (theirs > 4 * STD).any(axis=0)
        is_tracked = ~lost & ~lost_theirs
        ours = ours.mean(axis=0)[is_tracked]
        theirs = theirs.mean(axis=0)[is_tracked]
        ratio = ours.mean() / theirs.mean()
        # Both filters see the same data: a standard error of paired differences
        se = (ours - theirs).std(ddof=1) / theirs.mean() / ours.size**0.5
        # Two counts differ by about the square root of the number of lost runs.
        lost_more = (
            lost.sum() - lost_theirs.sum() > 2 * (lost | lost_theirs).sum() ** 0.5
        )
        yield {
            "ours": name,
            "runs": RUNS,
            "ratio_of_all": f"{ratio_of_all:.3f}",
            "lost": lost.sum(),
            "its_lost": lost_theirs.sum(),
            "error": f"{ours.mean():.4f}",
            "its_error": f"{theirs.mean():.4f}",
            "ratio": f"{ratio:.3f}",
            "se": f"{se:.3f}",
            "limit": limit,
            "missed": ratio - 2 * se > limit or lost_more,
        }


if __name__ == "__main__":
    main()

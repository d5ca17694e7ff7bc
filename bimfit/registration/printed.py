"""The search as printed, and the exhaustive one: what the proven search is measured against."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from bimfit.config import SearchConfig
from bimfit.registration import _kernels as kernels
from bimfit.registration.grcsm import Outcome, Problem, prior_table, unpack
from bimfit.registration.lattice import Integers
from bimfit.registration.table import aligned

_NONE: Integers = np.zeros(0, np.int64)


def run_printed(problem: Problem, config: SearchConfig) -> Outcome:
    """Paper, Eq. 3 to 5 and Fig. 3 and 4: pop the best block, stop at the first leaf. Not a proof."""
    tables, lattice, top = problem.tables, problem.tables.lattice, problem.tables.lattice.top
    if top == 0:  # one pose: nothing to search
        return replace(run_brute(problem, replace(config, prior_sigma=None)), stop="unproven")
    size = lattice.size
    fan = max((int((size[h] // size[h - 1]).prod()) for h in range(1, top + 1)), default=1)
    keys, codes = np.empty(64 * fan, np.int64), np.empty(64 * fan, np.int64)
    state = np.zeros(kernels.STATE_SIZE, np.int64)
    state[kernels.BEST] = kernels.NOTHING
    start = problem.start.copy()
    start[:2] += aligned(tables.origin, lattice)
    limit = config.max_evaluations if config.max_evaluations is not None else 1 << 60
    while True:
        ended = kernels.printed(
            problem.n, problem.pu, problem.pv, problem.weight, start, lattice.first[2],
            lattice.step[2], size, lattice.nodes, tables.blocks, tables.block_place, keys, codes, limit,
            state,
        )  # fmt: skip
        if ended != kernels.HEAP_FULL:
            break
        keys, codes = np.concatenate([keys, keys]), np.concatenate([codes, codes])
    return Outcome(
        int(state[kernels.BEST]), int(state[kernels.BOUND]), unpack(int(state[kernels.BEST_CODE])),
        int(state[kernels.EVALUATIONS]), "budget" if ended == kernels.BUDGET else "unproven", (_NONE, _NONE),
    )  # fmt: skip


def run_brute(problem: Problem, config: SearchConfig) -> Outcome:
    """Every pose of the window; ties go to the first in (theta, v, u) order."""
    tables, lattice = problem.tables, problem.tables.lattice
    prior, prior_at, has_prior = prior_table(config, lattice, problem.unit)
    state = np.zeros(kernels.STATE_SIZE, np.int64)
    kernels.brute(
        problem.n, problem.pu, problem.pv, problem.weight, problem.chunk, problem.start, tables.cosine,
        tables.sine, lattice.nodes, tables.lanes, prior, prior_at, has_prior, state,
    )  # fmt: skip
    return Outcome(
        int(state[kernels.BEST]), int(state[kernels.BOUND]), unpack(int(state[kernels.BEST_CODE])),
        int(state[kernels.EVALUATIONS]), "proven", (_NONE, _NONE),
    )  # fmt: skip

"""How fast a walk at random gets about with some options (Machado, Bellemare and Bowling 2017, section 4).

The diffusion time is the number of primitive steps that a policy which draws uniformly from the options available needs
to get from one state to another, mean over all pairs of different states; an option is stopped at the goal. Primitive
actions are options.

For option o let P_o hold its steps and B_o its ends, T = P_o (I - B_o) and N = (I - T)^-1. Without a goal a call takes
N 1 steps and leads to F = N P_o B_o. A goal g removes column g of T, which changes N by a matrix of rank one:

    N_g = N - (N - I)(., g) N(g, .) / N(g, g)

so one inverse per option and one linear solve per goal do.
"""

from __future__ import annotations

import numpy as np
from scipy import sparse
from scipy.sparse.csgraph import connected_components

from lodestone.errors import InvalidConfig, TooManyStates
from lodestone.options.base import NO_CAP
from lodestone.planning.option_models import OptionTables, check_available
from lodestone.planning.solve import ends_surely
from lodestone.planning.tables import Tables

MEMORY = 2**30
"""Bytes that the options' matrices may take."""
GOALS = 32
"""Goals whose equations are solved by one call."""


def diffusion_time(tables: Tables, options: OptionTables) -> float:
    """Mean steps between two states; inf where a walk need not arrive. Of `tables`, only where actions lead counts: a
    world in which something ends an episode is left only by mistake (see `envs.task.endless`).

    Raises `NoOptionAvailable`, `InvalidConfig` for options with a cap of more than one step, and `TooManyStates` where
    the options' matrices would take more than 1 GiB.
    """
    check_available(tables, options)
    size = tables.num_states
    long = [option for option, cap in enumerate(options.max_steps) if cap != 1]
    for option in long:
        if options.max_steps[option] != NO_CAP:
            raise InvalidConfig(
                f"Option {options.names[option]!r} is stopped after {options.max_steps[option]} steps, but diffusion "
                "times are of options that only their own termination ends."
            )
    if 16 * size * size * (len(long) + 1) > MEMORY:
        raise TooManyStates(
            f"Diffusion times of {len(long)} options over {size:,} states take more than {MEMORY // 2**30} GiB."
        )
    choice = options.initiation / options.initiation.sum(axis=0)
    arrives, steps = np.zeros((size, size)), np.zeros(size)
    passing, landing, lasting, visits = [], [], [], []
    for option in range(options.size):
        matrix = tables.policy_matrix(options.action_probs[option])
        if option not in long:
            arrives += choice[option][:, None] * matrix.toarray()
            steps += choice[option]
            continue
        stops = options.termination[option].astype(np.float64)
        going_on = matrix @ sparse.diags_array(1.0 - stops)
        sure = ends_surely(going_on, matrix @ stops > 0)
        if not sure[options.initiation[option]].all():
            return np.inf
        # What surely ends is followed by such states only: the others can be left out.
        inverse = np.linalg.inv(np.eye(size) - (sparse.diags_array(sure.astype(np.float64)) @ going_on).toarray())
        landing.append(inverse @ (matrix @ sparse.diags_array(stops)).toarray())
        lasting.append(inverse.sum(axis=1))
        visits.append(inverse.diagonal())
        passing.append(choice[option][:, None] * (inverse - np.eye(size)))
        arrives += choice[option][:, None] * landing[-1]
        steps += choice[option] * lasting[-1]
    if connected_components(sparse.csr_array(arrives > 0), connection="strong")[0] > 1:
        return np.inf

    total = 0.0
    for first in range(0, size, GOALS):
        goals = range(first, min(first + GOALS, size))
        chains, needs = np.empty((len(goals), size - 1, size - 1)), np.empty((len(goals), size - 1, 1))
        for row, goal in enumerate(goals):
            others = np.arange(size) != goal
            to_goal, needed = arrives, steps
            if long:
                share = np.stack([on[:, goal] / times[goal] for on, times in zip(passing, visits, strict=True)])
                to_goal = arrives - share.T @ np.stack([after[goal] for after in landing])
                needed = steps - share.T @ np.stack([time[goal] for time in lasting])
            chains[row] = np.eye(size - 1) - to_goal[np.ix_(others, others)]
            needs[row] = needed[others, None]
        total += np.linalg.solve(chains, needs).sum()
    return float(total / (size * (size - 1)))

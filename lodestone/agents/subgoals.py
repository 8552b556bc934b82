"""Options learned from samples of the problems that their sub-goals set."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from lodestone.agents.q_learning import STEPS_PER_ROUND, QLearningConfig, q_learning_on_numbers
from lodestone.learning.loop import train
from lodestone.options.base import Primitives
from lodestone.options.execution import Rules
from lodestone.options.subgoals import Subgoal, as_options, subproblem
from lodestone.options.tabular import TabularOptions, on_numbers
from lodestone.planning.enumerated import enumerated
from lodestone.planning.solve import greedy_choices
from lodestone.planning.tables import Tables


def learn_subgoals(
    config: QLearningConfig,
    tables: Tables,
    action_names: tuple[str, ...],
    subgoals: Sequence[Subgoal],
    rules: Rules,
    steps: int,
    seed: int,
) -> TabularOptions:
    """The option of each sub-goal by Q-learning of `steps` primitive steps on the problem that it sets, under the
    discount and the limits of `rules`: what `subgoal_options` finds exactly.

    Raises what `subproblem` raises, and `Diverged`.
    """
    actions = on_numbers(Primitives(action_names), tables.space)
    policies = []
    for subgoal in subgoals:
        world = enumerated(subproblem(tables, subgoal, rules.discount), action_names)
        algorithm = q_learning_on_numbers(config, world, actions, rules, steps)
        rounds = -(-steps // STEPS_PER_ROUND)
        for carry, _ in train(algorithm, [seed], rounds, rounds):
            policies.append(greedy_choices(np.asarray(carry.table[0], dtype=np.float64)))
    return as_options(tables, subgoals, policies)

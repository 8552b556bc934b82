"""Training any agent on any environment, from settings to policies."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import jax
import jax.numpy as jnp
import numpy as np

from lodestone.agents.dqn import DQNConfig, dqn
from lodestone.agents.intra_option import IntraOptionConfig, intra_option_q_learning
from lodestone.agents.q_learning import STEPS_PER_ROUND, QLearningConfig, q_learning
from lodestone.agents.saved import Policy
from lodestone.envs.base import Environment
from lodestone.learning.history import History
from lodestone.learning.loop import train
from lodestone.options.base import Options
from lodestone.options.execution import Rules

AgentConfig = DQNConfig | QLearningConfig | IntraOptionConfig

AGENTS: dict[str, type[AgentConfig]] = {
    "dqn": DQNConfig,
    "q-learning": QLearningConfig,
    "intra-option": IntraOptionConfig,
}
"""Every agent's settings, by the agent's name."""

CHUNKS = 100
"""Reports of progress per run, at most."""


def train_policy(
    config: AgentConfig,
    environment: Environment,
    options: Options,
    rules: Rules,
    length: int,
    seeds: Sequence[int],
    on_chunk: Callable[[History, float], bool] = lambda history, fraction: False,
) -> tuple[Policy, History]:
    """Train all seeds at once for `length` decisions each (tabular agents: primitive steps).

    `on_chunk` gets what happened so far and the fraction of the run that is over, and may end the run by returning
    True. Raises `InvalidConfig`, `Diverged`, `TooManyStates`, `NoOptionAvailable`.
    """
    match config:
        case DQNConfig():
            name, scale, rounds = "dqn", config.reward_scale, config.rounds(length)
            algorithm = dqn(config, environment, options, rules, length)
        case QLearningConfig():
            name, scale, rounds = "q-learning", 1.0, -(-length // STEPS_PER_ROUND)
            algorithm = q_learning(config, environment, options, rules, length)
        case IntraOptionConfig():
            name, scale, rounds = "intra-option", 1.0, -(-length // STEPS_PER_ROUND)
            algorithm = intra_option_q_learning(config, environment, options, rules, length)

    history = History(len(seeds), options.size)
    for carry, chunk in train(algorithm, seeds, rounds, -(-rounds // CHUNKS)):
        history.add(chunk)
        if on_chunk(history, chunk.rounds / rounds):
            break
    learned = carry.learner.network if name == "dqn" else carry.table
    learned = jax.tree.map(lambda leaf: jnp.asarray(np.asarray(leaf)[: len(seeds)]), learned)
    return Policy(name, environment, options, rules, learned, scale, tuple(seeds)), history

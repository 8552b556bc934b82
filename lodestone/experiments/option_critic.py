"""Option-critic in the four rooms, where the goal moves (Bacon, Harb and Precup 2017, section 6.1).

The goal is the hallway in the east. After 1000 episodes of its own each seed's goal moves to a cell of the lower right
room, drawn at random, and the learner goes on for 1000 more with what it has learned. A flat actor-critic is the same
learner with one option, whose termination changes nothing.
"""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from typing import Any, NamedTuple, get_args

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Int
from scipy.special import expit

from lodestone.agents.option_critic import OptionCriticConfig, option_critic_on_numbers
from lodestone.agents.q_learning import STEPS_PER_ROUND
from lodestone.agents.sarsa import SarsaConfig, sarsa_on_numbers
from lodestone.envs.four_rooms import NUMBER, Dynamics, FourRooms
from lodestone.envs.task import endless
from lodestone.experiments.changing_world import Moving, changing_world
from lodestone.experiments.comparison import Gate, at_least, at_most
from lodestone.experiments.study import Experiment, NumberTable, Panel, Series, Study
from lodestone.learning.history import History
from lodestone.learning.loop import Algorithm, train
from lodestone.learning.progress import Progress
from lodestone.options.base import Primitives
from lodestone.options.execution import Rules
from lodestone.options.soft import numbered_names
from lodestone.options.tabular import on_numbers
from lodestone.planning.enumerated import Enumerated, enumerated
from lodestone.planning.option_gradients import OptionParameters, SoftOptionProcess, soft_option_process
from lodestone.planning.solve import evaluate_policy, value_iteration
from lodestone.planning.tables import Tables, tabulate

EPISODES = 1000
"""Before the goal moves, and after."""
RULES = Rules(discount=0.99, step_limit=1000)
DYNAMICS: tuple[Dynamics, ...] = ("code", "text", "sps")
GOAL = int(NUMBER[7, 9])
ROOM = NUMBER[8:12, 7:12].ravel()
"""The cells of the lower right room."""

FOUR, EIGHT, FLAT, SARSA = "4 options", "8 options", "actor-critic", "SARSA"
EPSILON = ((0.0, 0.1),)
CONFIGS: dict[str, OptionCriticConfig | SarsaConfig] = {
    FOUR: OptionCriticConfig(num_options=4),
    EIGHT: OptionCriticConfig(num_options=8),
    FLAT: OptionCriticConfig(num_options=1),
    SARSA: SarsaConfig(learning_rate=((0.0, 0.5),), epsilon=EPSILON),
}
BLOCK = 20
"""Episodes whose mean is one point of a curve."""
LAST = 50
"""Episodes at the end, or after the move, whose mean is reported."""
ROUNDS_PER_LOOK = 50

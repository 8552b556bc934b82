"""Lodestone: hierarchical reinforcement learning with options, each learner beside the exact optimum."""

import gymnasium

__version__ = "0.1.0"

# The step limit is the environment's own (`truncated=True`), not `max_episode_steps`: Gymnasium's TimeLimit would count
# the same steps a second time. The entry points are strings, so that importing Lodestone does not import JAX.
gymnasium.register(
    id="lodestone/MagnetArm-v0",
    entry_point="lodestone.envs.gymnasium:make",
    vector_entry_point="lodestone.envs.gymnasium:make_vector",
    kwargs={"environment": "magnet-arm", "step_limit": 200},
)
gymnasium.register(
    id="lodestone/FourRooms-v0",
    entry_point="lodestone.envs.gymnasium:make",
    vector_entry_point="lodestone.envs.gymnasium:make_vector",
    kwargs={"environment": "four-rooms", "step_limit": 1000},
)

"""Lodestone: hierarchical reinforcement learning with options, each learner beside the exact optimum."""

import gymnasium

__version__ = "0.1.0"

# The step limit is the environment's own (`truncated=True`), not `max_episode_steps`: Gymnasium's TimeLimit would count
# the same steps a second time. The entry points are strings, so that importing Lodestone does not import JAX.
for _id, _name, _step_limit in (
    ("lodestone/MagnetArm-v0", "magnet-arm", 200),
    ("lodestone/FourRooms-v0", "four-rooms", 1000),
    ("lodestone/Taxi-v0", "taxi", 200),
    ("lodestone/CorridorMaze-v0", "corridor-maze", 2000),
    ("lodestone/TwoRooms-v0", "two-rooms", 100),
    ("lodestone/GoalMaze-v0", "goal-maze", 100),
    ("lodestone/Chain-v0", "chain", 100),
    ("lodestone/RandomMDP-v0", "random-mdp", 100),
):
    gymnasium.register(
        id=_id,
        entry_point="lodestone.envs.gymnasium:make",
        vector_entry_point="lodestone.envs.gymnasium:make_vector",
        kwargs={"environment": _name, "step_limit": _step_limit},
    )

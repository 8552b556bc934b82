"""Lodestone: hierarchical reinforcement learning with options, each learner beside the exact optimum."""

__version__ = "0.1.0"

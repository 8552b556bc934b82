"""Training a tabular learner and judging its greedy policies, exactly, as it goes."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float, Int

from lodestone.learning.history import History
from lodestone.learning.loop import Algorithm, train
from lodestone.planning.tables import Tables


class Followed(NamedTuple):
    """A training run of N seeds, looked at C times."""

    history: History
    episodes: Int[np.ndarray, "C N"]
    """Episodes that each seed had finished."""
    steps: Int[np.ndarray, "C N"]
    """Primitive steps that each seed had taken."""
    judged: Float[np.ndarray, "C N"]
    """What its greedy policy was worth then."""
    carry: Any
    """What each seed carried at the end, with a leading seed axis."""
    seconds: float

    def at(self, counts: Int[np.ndarray, "C N"], grid: Float[np.ndarray, " X"]) -> Float[np.ndarray, "N X"]:
        """The last judgement of each seed at each point of `grid`, where `counts` is `episodes` or `steps`; not a
        number before the first."""
        return at_looks(counts, self.judged, grid)

    def episode_lengths(self, episodes: int) -> Float[np.ndarray, "N E"]:
        """Primitive steps of each seed's first episodes, means of the last ten; not a number where it did not finish so
        many."""
        seeds = self.judged.shape[1]
        lengths = np.full((seeds, episodes), np.nan)
        for seed in range(seeds):
            steps = self.history.episodes(seed).length_steps[:episodes]
            lengths[seed, : len(steps)] = steps
        return np.stack([lengths[:, max(0, last - 9) : last + 1].mean(axis=1) for last in range(episodes)], axis=1)


def at_looks(
    counts: Float[np.ndarray, "C N"] | Int[np.ndarray, "C N"],
    seen: Float[np.ndarray, "C N"],
    grid: Float[np.ndarray, " X"],
) -> Float[np.ndarray, "N X"]:
    """What was seen of each seed at the last of C looks by each point of `grid`, if looks came at these counts; not a
    number before the first."""
    rows = zip(counts.T, seen.T, strict=True)
    return np.stack([np.insert(row, 0, np.nan)[np.searchsorted(count, grid, side="right")] for count, row in rows])


def follow(
    algorithm: Algorithm,
    choices: tuple[str, ...],
    seeds: int,
    rounds: int,
    looks: int,
    judge: Callable[[Any], Float[np.ndarray, " N"]],
    steps: int,
    tell: Callable[[float, str], None],
) -> Followed:
    """Train seeds 0, 1, ... until each has taken `steps` primitive steps, which takes at most `rounds`; about `looks`
    times call `judge` with what they carry. `tell` hears the fraction that is done."""
    history, looked = History(seeds, choices), []
    for carry, chunk in train(algorithm, range(seeds), rounds, max(1, rounds // looks)):
        history.add(chunk)
        taken = np.array([history.taken(seed)[1] for seed in range(seeds)])
        finished = np.array([len(history.episodes(seed).total_reward) for seed in range(seeds)])
        judged = judge(carry)
        looked.append((finished, taken, judged))
        tell(min(1.0, taken.min() / steps), f"greedy policies worth {np.mean(judged):.2f}")
        if taken.min() >= steps:
            break
    episodes, steps_taken, judged = (np.stack(column) for column in zip(*looked, strict=True))
    return Followed(history, episodes, steps_taken, judged, carry, history.seconds)


def return_within(tables: Tables, policies: Int[np.ndarray, "N S"], steps: int) -> Float[np.ndarray, " N"]:
    """Expected undiscounted return of each policy, from where episodes begin, in at most so many steps: finite also for
    policies that never end."""
    states = np.arange(tables.num_states)
    successors, probs = tables.successors[states, policies], tables.probs[states, policies]
    rewards = (probs * tables.rewards[states, policies]).sum(axis=-1)
    rows = np.arange(len(policies))[:, None, None]
    values = np.zeros(policies.shape)
    for _ in range(steps):
        values = rewards + (probs * values[rows, successors]).sum(axis=-1)
    return values @ tables.initial_probs

"""An invented study that looks like a real one: two panels of three learners, twenty seeds, tables, a machine."""

from __future__ import annotations

from functools import cache

import numpy as np
from fake_comparison import GATES

from lodestone.envs.magnet_arm import MagnetArm
from lodestone.experiments.study import LearnedMachines, NumberTable, Panel, Series, Study
from lodestone.machines.magnet_arm import pull_up
from lodestone.planning.joint import expected_visits, joint_process

SEEDS = 20
OPTIMUM, RECURSIVE = 7.93, 7.1


def learning(rng: np.random.Generator, x: np.ndarray, learnt_at: float, start: float, end: float) -> np.ndarray:
    """Rows of seeds that rise around one moment."""
    moments = learnt_at * rng.lognormal(0.0, 0.3, (SEEDS, 1))
    shares = 1 / (1 + np.exp((moments - x) / (0.15 * moments)))
    return start + (end - start) * shares + rng.normal(0, 0.02 * (end - start), (SEEDS, len(x)))


def make_study(points: int = 400) -> Study:
    """One learner begins late; another is infinitely bad at first."""
    rng = np.random.default_rng(3)
    episodes = np.linspace(0, 5000, points)
    steps = np.geomspace(100, 250_000, points)
    panels = []
    for title, label, x, log_x in (
        ("Greedy return over episodes", "episodes", episodes, False),
        ("Greedy return over primitive steps", "primitive steps", steps, True),
    ):
        late = learning(rng, x, 0.3 * x[-1], -200.0, OPTIMUM)
        late[:, x < 0.1 * x[-1]] = np.nan
        bad = learning(rng, x, 0.15 * x[-1], -150.0, RECURSIVE)
        bad[:12, x < 0.08 * x[-1]] = -np.inf
        panels.append(
            Panel(
                title,
                label,
                "greedy return, mean over the starts",
                (
                    Series("MAXQ-Q, abstraction", x, bad),
                    Series("MAXQ-Q, whole states", x, late),
                    Series("Q-learning, flat", x, learning(rng, x, 0.5 * x[-1], -120.0, OPTIMUM)),
                ),
                (("optimum 7.93", OPTIMUM), ("recursive optimum 7.1", RECURSIVE), ("random policy", -100.0)),
                log_x,
                (-60.0, 12.0),
            )
        )
    table = NumberTable(
        "Learners",
        ("", "values stored", "episodes to return 7.5", "kind"),
        (
            ("MAXQ-Q, abstraction", 632, 1410.5, "task graph"),
            ("MAXQ-Q, whole states", 14_000, float("inf"), "task graph"),
            ("Q-learning, flat", 3000, float("nan"), "flat"),
        ),
    )
    return Study(
        name="fake",
        title="An invented study",
        summary="Task graphs against flat learning.\n\nNothing of this was measured.",
        seeds=SEEDS,
        panels=tuple(panels),
        tables=(table,),
        gates=GATES,
        machines=(learned_machines(),),
    )


@cache
def learned_machines() -> LearnedMachines:
    """The pull-up machine on a small arm, every edge taken as often as any other."""
    arm = MagnetArm(rows=3, columns=2, bricks=2, tower_height=2)
    process = joint_process(arm, pull_up(arm))
    anything = process.available / process.available.sum(axis=1, keepdims=True)
    return LearnedMachines("The pull-up machine", process, expected_visits(process, anything))

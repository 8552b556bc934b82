"""An invented study that looks like a real one: two panels of three learners, twenty seeds, tables, a drawing."""

from __future__ import annotations

import numpy as np
from fake_comparison import GATES

from lodestone.experiments.study import NumberTable, Panel, Series, Study

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
        drawings=(("A machine of two states", MACHINE),),
    )


MACHINE = """<?xml version="1.0" encoding="UTF-8"?>
<svg xmlns="http://www.w3.org/2000/svg" width="360" height="140" viewBox="0 0 360 140">
<defs><marker id="tip" viewBox="0 0 8 8" refX="8" refY="4" markerWidth="8" markerHeight="8" orient="auto">
<path d="M0 0 8 4 0 8z" fill="#1f2933"/></marker></defs>
<circle cx="70" cy="70" r="36" fill="#ffffff" stroke="black" stroke-width="2"/>
<circle cx="290" cy="70" r="36" fill="none" stroke="#0072b2" stroke-width="2"/>
<text x="70" y="75" text-anchor="middle" font-size="14">search</text>
<text x="290" y="75" text-anchor="middle" font-size="14" fill="#0072b2">carry</text>
<path d="M108 70H250" stroke="#1f2933" fill="none" marker-end="url(#tip)"/>
<text x="180" y="62" text-anchor="middle" font-size="12">found</text>
</svg>
"""

"""The program `lodestone`: finds the command and runs it.

Exit codes: 0 done, 2 bad input (one sentence on standard error), 130 interrupted.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Sequence

from lodestone import __version__
from lodestone.agents.training import AGENTS
from lodestone.cli import discover, doctor, plan, pretrain, report, reproduce, resume, train, watch
from lodestone.devices import use_all_cores
from lodestone.discovery.catalogue import METHODS
from lodestone.envs.registry import ENVIRONMENTS
from lodestone.errors import LodestoneError, check_name
from lodestone.experiments.registry import EXPERIMENTS

COMMANDS: dict[str, Callable[[list[str]], None]] = {
    "reproduce": reproduce.run,
    "train": train.run,
    "resume": resume.run,
    "pretrain": pretrain.run,
    "watch": watch.run,
    "report": report.run,
    "plan": plan.run,
    "discover": discover.run,
    "doctor": doctor.run,
}
"""What each command does with the words after its name."""

USAGE = f"""usage: lodestone COMMAND ...

Hierarchical reinforcement learning with options, each learner beside the exact optimum.

commands:
  reproduce                  the paper's two figures, or another experiment: figures, report, numbers
  train AGENT ENVIRONMENT    train an agent ({", ".join(AGENTS)})
  resume RUN                 go on with a training run that was ended early, to the same bits
  pretrain ENVIRONMENT       train an environment's options as Q-networks
  watch RUN                  play a saved policy
  report RUN ...             a page about training runs: curves, comparisons, an episode of each
  plan ENVIRONMENT           the exact optimum
  discover ENVIRONMENT       find options by --method {", ".join(METHODS)}
  doctor                     what is installed here, what is missing, and how to get it

environments: {", ".join(ENVIRONMENTS)}
experiments: {", ".join((reproduce.MAGNET_TOWER, *EXPERIMENTS))}

Add --help after a command and its names for all settings. lodestone --version prints the version.
"""


def main(arguments: Sequence[str] | None = None) -> int:
    """Run one command; returns the exit code."""
    words = list(sys.argv[1:] if arguments is None else arguments)
    if not words or words[0] in ("-h", "--help"):
        print(USAGE, end="")
        return 0
    if words[0] == "--version":
        print(f"lodestone {__version__}")
        return 0
    use_all_cores()
    try:
        check_name("command", words[0], tuple(COMMANDS))
        COMMANDS[words[0]](words[1:])
    except LodestoneError as error:
        print(f"lodestone: {error}", file=sys.stderr)
        return 2
    except KeyboardInterrupt as interrupt:
        print(f"\nlodestone: {str(interrupt) or 'interrupted.'}", file=sys.stderr)
        return 130
    return 0

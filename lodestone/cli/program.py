"""The program `lodestone`: finds the command and runs it.

Exit codes: 0 done, 1 some trials of a sweep failed, 2 bad input (one sentence on standard error), 130 interrupted.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Sequence
from io import TextIOWrapper

from jax.errors import JaxRuntimeError

from lodestone import __version__
from lodestone.agents.training import AGENTS
from lodestone.cli import (
    completion,
    discover,
    doctor,
    plan,
    pretrain,
    report,
    reproduce,
    resume,
    sweep,
    tensorboard,
    train,
    watch,
)
from lodestone.devices import use_all_cores
from lodestone.discovery.catalogue import METHODS
from lodestone.envs.registry import ENVIRONMENTS
from lodestone.errors import LodestoneError, check_name
from lodestone.experiments.registry import EXPERIMENTS

COMMANDS: dict[str, Callable[[list[str]], None]] = {
    "reproduce": reproduce.run,
    "train": train.run,
    "resume": resume.run,
    "sweep": sweep.run,
    "pretrain": pretrain.run,
    "watch": watch.run,
    "report": report.run,
    "tensorboard": tensorboard.run,
    "plan": plan.run,
    "discover": discover.run,
    "doctor": doctor.run,
    "completion": completion.run,
}
"""What each command does with the words after its name."""

USAGE = f"""usage: lodestone COMMAND ...

Hierarchical reinforcement learning with options, each learner beside the exact optimum.

commands:
  reproduce                  the paper's two figures, or another experiment: figures, report, numbers
  train AGENT ENVIRONMENT    train an agent ({", ".join(AGENTS)})
  resume RUN                 go on with a training run that was ended early, to the same bits
  sweep PLAN --out FOLDER    train many configurations on many seeds, on this machine or a Ray cluster
  pretrain ENVIRONMENT       train an environment's options as Q-networks
  watch RUN                  play a saved policy
  report RUN ...             a page about training runs: curves, comparisons, an episode of each
  tensorboard RUN ...        training runs for TensorBoard
  plan ENVIRONMENT           the exact optimum
  discover ENVIRONMENT       find options by --method {", ".join(METHODS)}
  doctor                     what is installed here, what is missing, and how to get it
  completion SHELL           a script that completes all these words on TAB, for bash, zsh or fish

environments: {", ".join(ENVIRONMENTS)}
experiments: {", ".join((reproduce.MAGNET_TOWER, *EXPERIMENTS))}

Add --help after a command and its names for all settings. lodestone --version prints the version.
"""

NO_MEMORY = ("RESOURCE_EXHAUSTED", "Out of memory")
"""What errors of XLA say of it."""


def main(arguments: Sequence[str] | None = None) -> int:
    """Run one command; returns the exit code."""
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, TextIOWrapper):
            stream.reconfigure(errors="backslashreplace")  # a path may have characters that cannot be printed
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
        return _refuse(str(error))
    except OSError as error:  # a path that no file can have, or a disk or a terminal that went away
        return _refuse(f"{error.filename or 'The output'}: {error.strerror or error}.")
    except (MemoryError, JaxRuntimeError) as error:
        if isinstance(error, JaxRuntimeError) and not any(word in str(error) for word in NO_MEMORY):
            raise
        return _refuse("This would take more memory than there is.")
    except KeyboardInterrupt as interrupt:
        print(f"\nlodestone: {str(interrupt) or 'interrupted.'}", file=sys.stderr)
        return 130
    return 0


def _refuse(sentence: str) -> int:
    print(f"lodestone: {sentence}", file=sys.stderr)
    return 2

"""Every error that bad input can cause, each a named exception whose message is one sentence for a person.

The command line prints the message and leaves with exit code 2; a library user catches the class.
"""

from __future__ import annotations


class LodestoneError(ValueError):
    """Base of all errors that Lodestone raises on purpose."""


class InvalidConfig(LodestoneError):
    """A parameter is outside what is allowed; the message says which, and what is."""


class UnknownName(LodestoneError):
    """A name of an environment, agent, option, preset or experiment that does not exist."""


class NoOptionAvailable(LodestoneError):
    """A reachable state where no option may start."""


class InvalidTaskGraph(LodestoneError):
    """Subtasks that call what does not exist, call one another in a circle, or get stuck."""


class InvalidMachine(LodestoneError):
    """An abstract machine that names what does not exist, runs on without taking time, calls itself, or gets stuck."""


class BadFile(LodestoneError):
    """A file that is missing, truncated, foreign, or saved for another problem."""


class CannotWrite(LodestoneError):
    """An output folder or file that cannot be written."""


class TooManyStates(LodestoneError):
    """More reachable states than an exact method was allowed to enumerate."""


class Unbounded(LodestoneError):
    """Without a discount a cycle of states pays, so that there is no finite optimum."""


class CannotDiscover(LodestoneError):
    """A world, or trajectories, without what a method of discovery looks for: no success, no edge, pieces apart."""


class EnvironmentFailed(LodestoneError):
    """An environment that lives outside the program raised an error while an agent acted in it."""


class Diverged(LodestoneError):
    """A loss or a parameter stopped being a finite number during training."""


def check_name(kind: str, name: str, known: tuple[str, ...]) -> None:
    """Raise `UnknownName` unless `name` is one of `known`."""
    if name not in known:
        others = f"there are: {', '.join(known)}" if known else "there are none here"
        raise UnknownName(f"There is no {kind} named {name!r}; {others}.")

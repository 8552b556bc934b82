"""From words to settings: what every command's parsing shares."""

from __future__ import annotations

from typing import Any

import tyro
from tyro.conf import OmitArgPrefixes

from lodestone.envs.base import Environment
from lodestone.envs.host import Registered, is_registered
from lodestone.envs.registry import ENVIRONMENTS, environment_class
from lodestone.errors import InvalidConfig, UnknownName, check_name
from lodestone.settings import check_numbers

MAX_SEEDS = 100_000
"""That are trained at once."""


def take_name(kind: str, known: tuple[str, ...], command: str, words: list[str]) -> tuple[str, list[str]]:
    """The first word, a name, and the rest. Raises `InvalidConfig` without a word and `UnknownName`."""
    if not words or words[0].startswith("-"):
        raise InvalidConfig(f"`lodestone {command}` needs the name of an {kind}; there are: {', '.join(known)}.")
    check_name(kind, words[0], known)
    return words[0], words[1:]


def take_setting(kind: str, known: tuple[str, ...], command: str, words: list[str]) -> tuple[str, list[str]]:
    """The name after `--kind` or `--kind=`, wherever it stands, and the other words: where it decides which settings
    there are. Raises `InvalidConfig` without it and `UnknownName`."""
    flag = f"--{kind}"
    words = [part for word in words for part in (word.split("=", 1) if word.startswith(f"{flag}=") else [word])]
    if flag not in words[:-1]:
        raise InvalidConfig(f"`lodestone {command}` needs {flag} and one of: {', '.join(known)}.")
    at = words.index(flag)
    check_name(kind, words[at + 1], known)
    return words[at + 1], words[:at] + words[at + 2 :]


def take_environment(command: str, words: list[str]) -> tuple[str, type[Environment], list[str]]:
    """An environment's name, its class, and the rest: a Gymnasium id is a setting of its class.

    Raises `InvalidConfig` and `UnknownName`.
    """
    if words and is_registered(words[0]):
        return words[0], Registered, ["--id", *words]
    try:
        name, rest = take_name("environment", tuple(ENVIRONMENTS), command, words)
    except UnknownName as error:
        raise UnknownName(f"{str(error).rstrip('.')}, and the ids of Gymnasium, as id or module:id.") from None
    return name, environment_class(name), rest


def check_seeds(seeds: int) -> None:
    """Raises `InvalidConfig`."""
    if not 1 <= seeds <= MAX_SEEDS:
        raise InvalidConfig(f"seeds is {seeds}, but must be at least 1 and at most {MAX_SEEDS}.")


def settings_of(command: Any, *kinds: type) -> Any:
    """A command's settings for an agent and an environment that are known only now."""
    return command[kinds]


def parse(settings: Any, command: str, words: list[str]) -> Any:
    """Parsing errors leave with exit code 2 from inside tyro, after one boxed sentence. Raises `InvalidConfig` for a
    number that is too large."""
    found = tyro.cli(settings, args=words, prog=f"lodestone {command}", config=(OmitArgPrefixes,))
    check_numbers(found, command)
    return found

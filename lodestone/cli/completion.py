"""`lodestone completion SHELL`: a script that completes the program's words.

Every word is in the script, so that no TAB waits for Python. Flags, and what may follow them, come from the settings,
as the parser's do. Each name that was typed, of a command, an agent, an environment or a method, brings its own flags;
no two of them have one name.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, fields, is_dataclass
from pathlib import Path
from types import NoneType, UnionType
from typing import Annotated, Any, Literal, NamedTuple, TypeVar, Union, get_args, get_origin, get_type_hints

import gymnasium
from tyro.conf import Positional

from lodestone.agents.training import AGENTS
from lodestone.cli.discover import Discover
from lodestone.cli.doctor import Doctor
from lodestone.cli.parsing import parse
from lodestone.cli.plan import Plan
from lodestone.cli.pretrain import Pretrain
from lodestone.cli.report import Report
from lodestone.cli.reproduce import MAGNET_TOWER, Reproduce
from lodestone.cli.resume import Resume
from lodestone.cli.sweep import Sweep
from lodestone.cli.tensorboard import TensorBoard
from lodestone.cli.train import Train
from lodestone.cli.watch import Watch
from lodestone.discovery.catalogue import METHODS
from lodestone.envs.host import Registered
from lodestone.envs.registry import ENVIRONMENTS, GYMNASIUM
from lodestone.experiments.registry import EXPERIMENTS
from lodestone.options.catalogue import option_names

Shell = Literal["bash", "zsh", "fish"]


@dataclass(frozen=True)
class Completion:
    """Print a script with which a shell completes the words of lodestone on TAB.

    It belongs into ~/.local/share/bash-completion/completions/lodestone (bash), into
    ~/.config/fish/completions/lodestone.fish (fish), or into a file that ~/.zshrc sources (zsh)."""

    shell: Positional[Shell]
    """bash, zsh or fish."""


SETTINGS: dict[str, type] = {
    "reproduce": Reproduce,
    "train": Train,
    "resume": Resume,
    "sweep": Sweep,
    "pretrain": Pretrain,
    "watch": Watch,
    "report": Report,
    "tensorboard": TensorBoard,
    "plan": Plan,
    "discover": Discover,
    "doctor": Doctor,
    "completion": Completion,
}
"""Every command's settings."""

COMMANDS_OF_FILES = ("resume", "sweep", "watch", "report", "tensorboard")
MANY = 99
"""Words after a flag that takes any number of them."""


class Flag(NamedTuple):
    """A flag, and what may follow it."""

    name: str
    takes: int = 0
    """Words after it, at most."""
    words: tuple[str, ...] = ()
    """Which these may be, as far as they are known."""
    files: bool = False
    """Whether they may be files."""


def run(words: list[str]) -> None:
    """Parse the words after `completion` and print."""
    settings: Completion = parse(Completion, "completion", words)
    print({"bash": bash_script, "zsh": zsh_script, "fish": fish_script}[settings.shell](), end="")


def flags_of(settings: type) -> Iterator[Flag]:
    """Of settings, those inside others too."""
    kinds = get_type_hints(settings, include_extras=True)
    for field in fields(settings):
        kind, notes = kinds[field.name], list[Any]()
        if get_origin(kind) is Annotated:
            kind, *notes = get_args(kind)
        if isinstance(kind, TypeVar) or Positional in notes:
            continue
        name = next((note.name for note in notes if getattr(note, "name", None)), field.name).replace("_", "-")
        if get_origin(kind) in (Union, UnionType):
            (kind,) = (one for one in get_args(kind) if one is not NoneType)
        if is_dataclass(kind):
            yield from flags_of(kind)  # type: ignore[arg-type]
        elif kind is bool:
            yield Flag(f"--no-{name}" if field.default is True else f"--{name}")
        elif name == "options":  # text to the parser; `options` has the names
            yield Flag("--options", MANY, files=True)
        elif name == "experiment":
            yield Flag("--experiment", 1, (MAGNET_TOWER, *EXPERIMENTS))
        elif get_origin(kind) is Literal:
            yield Flag(f"--{name}", 1, get_args(kind))
        else:
            yield Flag(f"--{name}", MANY if get_origin(kind) is tuple else 1, files=kind is Path)


def flags() -> dict[str, tuple[Flag, ...]]:
    """The flags that each name brings."""
    found = {name: (*flags_of(kind), Flag("--help")) for name, kind in SETTINGS.items()}
    found["discover"] += (Flag("--method", 1, tuple(METHODS)),)
    found |= {name: tuple(flags_of(kind)) for name, kind in (AGENTS | ENVIRONMENTS | METHODS).items()}
    return found | {GYMNASIUM: tuple(flag for flag in flags_of(Registered) if flag.name != "--id")}


def options() -> dict[str, tuple[str, ...]]:
    """The ready-made options of each environment that has any."""
    found = {name: option_names(kind()) for name, kind in ENVIRONMENTS.items()}
    return {name: names for name, names in found.items() if names}


def names() -> dict[tuple[str, int], tuple[str, ...]]:
    """What may be the n-th word of a command; of the program, a command."""
    environments = tuple(ENVIRONMENTS)
    return {
        ("lodestone", 1): (*SETTINGS, "--help", "--version"),
        ("train", 2): tuple(AGENTS),
        ("train", 3): (*environments, *sorted(name for name in gymnasium.registry if "/" not in name)),
        **{(command, 2): environments for command in ("pretrain", "plan", "discover")},
        ("completion", 2): get_args(Shell),
    }


_BASH = """\
# Completes the words of lodestone; `lodestone completion` has made it.
_lodestone_about() {
    case $1 in
%s
    esac
}

_lodestone() {
    local word=${COMP_WORDS[COMP_CWORD]} flag= flags= words= files= takes=0 given=0 at one
    local -a before=()
    for ((at = 1; at < COMP_CWORD; at++)); do
        one=${COMP_WORDS[at]}
        case $one in
            --*) flag=$one given=0; continue ;;
            *-v[0-9]|*:*) one=gymnasium ;;
        esac
        _lodestone_about "$one"
        before+=("$one")
        ((given += 1))
    done
    if [[ -n $flag ]]; then
        for one in "${before[@]}"; do
            _lodestone_about "$one $flag"
        done
        ((given < takes)) || words= files=
    elif ((COMP_CWORD == 1)); then
        _lodestone_about 'lodestone 1'
    else
        _lodestone_about "${COMP_WORDS[1]} $COMP_CWORD"
    fi
    if [[ $word == -* && $COMP_CWORD -gt 1 ]] || [[ -z $words && -z $files && $given -ge $takes ]]; then
        words=$flags files=
    fi
    COMPREPLY=($(compgen -W "$words" -- "$word"))
    if [[ -n $files ]]; then
        compopt -o filenames 2>/dev/null
        local IFS=$'\\n'
        COMPREPLY+=($(compgen -f -- "$word"))
    fi
}

complete -F _lodestone lodestone
"""


def bash_script() -> str:
    """One table of what is known about a name, about a flag after it, and about a place in a command."""
    known = flags()
    about = {f"'{name}'": f"flags+=' {' '.join(flag.name for flag in those)}'" for name, those in known.items()}
    about |= {f"'{first} {place}'": f"words='{' '.join(some)}'" for (first, place), some in names().items()}
    about |= {f"'{command} '[0-9]*": "files=1" for command in COMMANDS_OF_FILES}
    alike: dict[Flag, list[str]] = {}
    for name, flag in (
        *((name, flag) for name, those in known.items() for flag in those if flag.takes),
        *((name, Flag("--options", MANY, some)) for name, some in options().items()),
    ):
        alike.setdefault(flag._replace(name=""), []).append(f"'{name} {flag.name}'")
    for flag, patterns in alike.items():
        some = f" words+=' {' '.join(flag.words)}'" if flag.words else ""
        about["|".join(patterns)] = f"takes={flag.takes}{some}{' files=1' if flag.files else ''}"
    return _BASH % "\n".join(f"        {pattern}) {action} ;;" for pattern, action in about.items())


def zsh_script() -> str:
    """That of bash, which zsh can take."""
    load = "autoload -Uz compinit bashcompinit\n(( $+functions[compdef] )) || compinit\nbashcompinit\n"
    return load + bash_script()


def fish_script() -> str:
    """One line for each flag of each name."""
    typed, seen = "(commandline -opc)", "__fish_seen_subcommand_from"
    lines = ["complete -c lodestone -f"]
    for (first, place), words in names().items():
        after = "" if first == "lodestone" else f"; and {seen} {first}"
        lines.append(f"complete -c lodestone -n 'test (count {typed}) -eq {place}{after}' -a '{' '.join(words)}'")
    lines += [f"complete -c lodestone -n '{seen} {command}' -F" for command in COMMANDS_OF_FILES]
    for name, those in flags().items():
        here = f"{seen} {name}" if name != GYMNASIUM else f'string match -qr -- "-v[0-9]|:" {typed}'
        for flag in those:
            takes = "" if not flag.takes else " -r -F" if flag.files else " -x"
            which = f" -a '{' '.join(flag.words)}'" if flag.words else ""
            lines.append(f"complete -c lodestone -n '{here}' -l {flag.name[2:]}{takes}{which}")
    for name, words in options().items():
        here = f"{seen} train plan; and {seen} {name}"
        more = f'string match -qr -- " --options( [^-]\\S*)+\\$" (string join " " -- {typed})'
        lines.append(f"complete -c lodestone -n '{here}' -l options -r -F -a '{' '.join(words)}'")
        lines.append(f"complete -c lodestone -n '{here}; and {more}' -a '{' '.join(words)}'")
    return "\n".join(lines) + "\n"

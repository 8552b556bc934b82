"""What a shell offers on TAB, beside what the parser takes."""

from __future__ import annotations

import ast
import re
import shutil
import subprocess
from pathlib import Path

import pytest

from lodestone.agents.dqn import DQNConfig
from lodestone.agents.training import AGENTS
from lodestone.cli import main
from lodestone.cli.completion import MANY, SETTINGS, flags
from lodestone.cli.discover import Discover
from lodestone.cli.parsing import parse, settings_of
from lodestone.cli.plan import Plan
from lodestone.cli.pretrain import Pretrain
from lodestone.cli.program import COMMANDS
from lodestone.cli.train import Train
from lodestone.discovery.catalogue import METHODS
from lodestone.envs.chain import Chain
from lodestone.envs.host import Registered
from lodestone.envs.registry import ENVIRONMENTS, GYMNASIUM


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Has a script for each shell, and some files."""
    found = tmp_path_factory.mktemp("completion")
    (found / "runs" / "a").mkdir(parents=True)
    (found / "a file").touch()
    return found


def script(shell: str, capsys: pytest.CaptureFixture[str]) -> str:
    """What the program prints."""
    assert main(["completion", shell]) == 0
    return capsys.readouterr().out


CASES = [
    ("tr", ["train"]),
    ("re", ["report", "reproduce", "resume"]),
    ("train dq", ["dqn"]),
    ("train dqn ma", ["magnet-arm"]),
    ("train dqn Cart", ["CartPole-v0", "CartPole-v1"]),
    ("train dqn magnet-arm --tower", ["--tower-height", "--tower-reward"]),
    ("train dqn taxi --tower", []),
    ("train dqn taxi --huber", ["--huber-delta"]),
    ("train maxq taxi --huber", []),
    ("train dqn CartPole-v1 --max-e", ["--max-episode-steps"]),
    ("train dqn magnet-arm --options ", ["go-down", "lift", "a file", "runs"]),
    ("train dqn magnet-arm --options go-down li", ["lift"]),
    ("train dqn magnet-arm --options go-down --see", ["--seed", "--seeds"]),
    ("train sarsa four-rooms --options hallways south-east-to-s", ["south-east-to-south"]),
    ("train dqn magnet-arm --observation ", ["index", "planes", "rgb"]),
    ("train dqn magnet-arm --steps ", []),
    ("train dqn magnet-arm --steps 500 --json --ou", ["--out"]),
    ("train dqn magnet-arm --out ru", ["runs"]),
    ("train dqn magnet-arm --out runs --no-p", ["--no-primitives"]),
    ("plan four-rooms --dyn", ["--dynamics"]),
    ("discover four-rooms --method ", ["betweenness", "covering", "diverse-density", "eigenoptions"]),
    ("discover four-rooms --method eigenoptions --bas", ["--basis"]),
    ("discover four-rooms --fr", ["--from"]),
    ("reproduce --experiment h", ["hallways", "hdqn"]),
    ("reproduce --figure ", ["2", "3", "all"]),
    ("watch runs/", ["runs/a"]),
    ("report runs/a a", ["a file"]),
    ("completion ", ["bash", "fish", "zsh"]),
]


def test_bash_offers_what_may_follow(folder, capsys):
    (folder / "script").write_text(script("bash", capsys))
    ask = 'source ./script; COMP_WORDS=("$@"); COMP_CWORD=$(($# - 1)); _lodestone; printf "%s\\n" "${COMPREPLY[@]}"'
    for line, offered in CASES:
        words = ["bash", "--norc", "-c", ask, "bash", "lodestone", *line.split(" ")]
        told = subprocess.run(words, cwd=folder, capture_output=True, text=True, check=True)
        assert (line, told.stderr) == (line, "")
        assert (line, set(told.stdout.splitlines()) - {"", "script"}) == (line, set(offered))


@pytest.mark.skipif(shutil.which("fish") is None, reason="there is no fish")
def test_fish_does_too(folder, capsys):
    (folder / "script").write_text(script("fish", capsys))
    for line, offered in CASES:
        words = ["fish", "--no-config", "-c", f"source ./script; complete -C 'lodestone {line}'"]
        told = subprocess.run(words, cwd=folder, capture_output=True, text=True, check=True)
        found = {one.split("\t")[0].rstrip("/").replace("\\ ", " ") for one in told.stdout.splitlines()}
        assert (line, told.stderr) == (line, "")
        assert (line, found - {"script"}) == (line, set(offered))


TOGETHER = [
    *((kind, (name,)) for name, kind in SETTINGS.items() if not hasattr(kind, "__parameters__")),
    *((settings_of(Train, kind, Chain), ("train", name, "chain")) for name, kind in AGENTS.items()),
    *((settings_of(Plan, kind), ("plan", name)) for name, kind in ENVIRONMENTS.items()),
    *((settings_of(Discover, kind, Chain), ("discover", "chain", name)) for name, kind in METHODS.items()),
    (settings_of(Train, DQNConfig, Registered), ("train", "dqn", GYMNASIUM)),
    (settings_of(Pretrain, Chain), ("pretrain", "chain")),
]


@pytest.mark.parametrize(("settings", "names"), TOGETHER)
def test_flags_are_those_of_the_parser(settings, names, capsys):
    """The parser can say itself what it takes, of one set of settings."""
    with pytest.raises(SystemExit):
        parse(settings, "", ["--tyro-print-completion", "bash"])
    (told,) = re.findall(r"COMPLETION_SPEC = (.*)", capsys.readouterr().out)
    offered = {flag.name: flag for name in names for flag in flags()[name]}
    offered.pop("--method", None)  # which is taken before the parser comes
    for one in ast.literal_eval(told)["options"]:
        (name,) = offered.keys() & set(one["flags"]) or ("--id",)
        if name == "--id":  # which stands in the place of the environment's name
            assert GYMNASIUM in names
            continue
        flag = offered.pop(name)
        assert (name, flag.takes > 0) == (name, one["type"] not in ("boolean", "flag"))
        assert (name, flag.takes == MANY) == (name, one.get("nargs") in ("*", "+"))
        if name != "--experiment":
            assert (name, flag.words) == (name, tuple(one.get("choices", ())))
    assert not offered


def test_every_name_means_one_thing():
    assert set(SETTINGS) == set(COMMANDS)
    assert len(flags()) == len(SETTINGS) + len(AGENTS) + len(ENVIRONMENTS) + len(METHODS) + 1

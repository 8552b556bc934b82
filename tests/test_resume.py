"""Runs survive: whatever ends the process, `lodestone resume` goes on to the bits of a run that was not ended."""

from __future__ import annotations

import json
import os
import random
import resource
import shutil
import signal
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from processes import Program, count_lines

from lodestone.cli import main
from lodestone.files import lock, read_arrays

ARM = ["magnet-arm", "--rows", "3", "--columns", "3", "--bricks", "2", "--tower-height", "2"]
NETWORK = ["--observation", "planes", "--kernels", "--strides", "--channels", "--hidden", "16"]
WORDS = {
    "tabular": ["q-learning", "chain", "--steps", "5000"],
    "options": ["dqn", *ARM, *NETWORK, "--options", "go-down", "lift", "--learning-starts", "100", "--steps", "1500"],
    "united": ["united", *ARM, *NETWORK, "--learning-starts", "100", "--steps", "1500"],
}


@pytest.fixture(scope="module")
def program(tmp_path_factory) -> Program:
    return Program(tmp_path_factory.mktemp("program"))


@pytest.fixture(scope="module")
def whole(program) -> Callable[[str], Path]:
    """The folder of a run that was not ended early."""

    def find(name: str) -> Path:
        folder = program.folder / name
        if not folder.exists():
            assert program.run(*train(name, folder))[0] == 0
        return folder

    return find


@pytest.fixture(scope="module")
def unfinished(program) -> Path:
    """The folder of a run that was killed."""
    folder = program.folder / "unfinished"
    chance = random.Random(0)
    code, _ = program.end(signal.SIGKILL, folder, 40, chance.uniform(0, 0.01), *train("tabular", folder))
    assert code == -signal.SIGKILL
    return folder


def train(name: str, out: Path, every: str = "0") -> list[str]:
    return ["train", *WORDS[name], "--seeds", "2", "--out", str(out), "--checkpoint-every", every]


def metrics(run: Path) -> list[dict[str, Any]]:
    lines = [json.loads(line) for line in (run / "metrics.jsonl").read_text().splitlines()]
    return [{name: value for name, value in line.items() if name != "seconds"} for line in lines]


def assert_same(run: Path, whole: Path) -> None:
    """Every array and every line is that of the run that was not ended, and nothing half written is left."""
    assert metrics(run) == metrics(whole)
    found, wanted = (read_arrays(folder / "policy.safetensors")[0] for folder in (run, whole))
    assert found.keys() == wanted.keys()
    for name in wanted:
        np.testing.assert_array_equal(found[name], wanted[name], err_msg=name)
    assert (run / "policy.safetensors").read_bytes() == (whole / "policy.safetensors").read_bytes()
    assert list(run.rglob("*.tmp")) == []
    assert len(list((run / "checkpoints").iterdir())) <= 2


def die_in_write(name: str, count: int, where: str) -> None:
    """Kill this process in its `count`th write of a file whose path contains `name`: when half of it is on the disk
    (`fsync`), or right before or after it gets its name."""
    replace, fsync, seen = os.replace, os.fsync, [0]

    def half(file: int) -> None:
        fsync(file)
        if name in os.readlink(f"/proc/self/fd/{file}") and where == "fsync" and due():
            os.ftruncate(file, os.fstat(file).st_size // 2)
            die()

    def named(old: Path, new: Path) -> None:
        dies = name in str(new) and where != "fsync" and due()
        if not (dies and where == "before"):
            replace(old, new)
        if dies:
            die()

    def due() -> bool:
        seen[0] += 1
        return seen[0] == count

    def die() -> None:
        os.kill(os.getpid(), signal.SIGKILL)

    os.fsync, os.replace = half, named  # type: ignore[assignment]


def fill_disk(size: int) -> None:
    """Let this process write no file of more bytes."""
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, size))


def flip(path: Path, position: float) -> None:
    """One bit of a file, at a fraction of its length."""
    content = bytearray(path.read_bytes())
    content[int(position * len(content))] ^= 4
    path.write_bytes(content)


def checkpoints(run: Path) -> list[Path]:
    return sorted((run / "checkpoints").glob("*.safetensors"))


def test_a_run_survives_every_end(program, whole, unfinished, tmp_path):
    """One run that ends in every way there is, one after another: killed at any moment and inside two writes,
    interrupted, out of disk, with a damaged checkpoint."""
    run = tmp_path / "run"
    shutil.copytree(unfinished, run)  # killed once
    resume = ["resume", str(run)]
    assert program.run(*resume, prepare=partial(die_in_write, "checkpoints/", 3, "fsync"))[0] == -signal.SIGKILL

    code, printed = program.end(signal.SIGINT, run, 10, 0.0, *resume)
    assert code == 130
    assert printed.endswith(f"\nlodestone: interrupted; `lodestone resume {run}` goes on.\n")
    assert len(metrics(run)) == 2 * _chunks(checkpoints(run)[-1])  # one more was written

    code, printed = program.run(*resume, prepare=partial(fill_disk, checkpoints(run)[-1].stat().st_size))
    assert code == 2
    assert printed.splitlines()[-1].startswith(f"lodestone: Cannot write {run}/checkpoints/")

    damaged = checkpoints(run)[-1]
    flip(damaged, 0.7)
    code, printed = program.run(*resume, prepare=partial(die_in_write, "policy", 1, "fsync"))
    assert code == -signal.SIGKILL
    assert f"lodestone: note: {damaged} is damaged: its checksum does not fit. The one before it is used.\n" in printed
    assert program.run(*resume)[0] == 0
    assert_same(run, whole("tabular"))


def test_metrics_that_cannot_be_written_are_said(program, tmp_path):
    run = tmp_path / "run"
    code, printed = program.run(*train("tabular", run, every="60"), prepare=partial(fill_disk, 4000))
    assert code == 2
    assert printed.splitlines()[-1] == f"lodestone: Cannot write {run}/metrics.jsonl: File too large."
    assert "Traceback" not in printed


def _chunks(checkpoint: Path) -> int:
    return len(read_arrays(checkpoint)[0]["history/usage/seconds"])


@pytest.mark.parametrize(("name", "kills"), [("options", 2), pytest.param("united", 1, marks=pytest.mark.slow)])
def test_networks_survive_being_killed(name, kills, program, whole, tmp_path):
    run, chance = tmp_path / "run", random.Random(1)
    words = train(name, run)
    for _ in range(kills):
        code, _ = program.end(signal.SIGKILL, run, chance.randint(2, 70), chance.uniform(0, 0.03), *words)
        assert code == -signal.SIGKILL
        words = ["resume", str(run)]
    assert program.run(*words)[0] == 0
    assert_same(run, whole(name))


@pytest.mark.slow
@pytest.mark.parametrize("name", list(WORDS))
def test_twenty_kills_of_twenty_are_survived(name, program, whole, tmp_path):
    """At any moment from the first call to the last byte. Where the run is over sooner, there is one kill more."""
    chance, lines, kills = random.Random(20), count_lines(whole(name)), 0
    while kills < 20:
        run = tmp_path / f"{chance.random()}"
        moment = chance.uniform(-0.1, 1.0)
        at, delay = (0, chance.uniform(0, 1.0)) if moment < 0 else (int(moment * lines), chance.uniform(0, 0.02))
        words = train(name, run, every=chance.choice(["0", "0.3"]))
        code, _ = program.end(signal.SIGKILL, run, at, delay, *words)
        kills += code == -signal.SIGKILL
        assert code in (-signal.SIGKILL, 0)
        if (run / "config.json").exists():
            words = ["resume", str(run)]
        assert program.run(*words)[0] == 0
        assert_same(run, whole(name))


@pytest.mark.slow
@pytest.mark.parametrize("where", ["fsync", "before", "after"])
@pytest.mark.parametrize(
    ("name", "count"),
    [
        ("options", 1),
        ("config", 1),
        ("metrics", 1),
        ("checkpoints/", 1),
        ("checkpoints/", 2),
        ("checkpoints/", 40),
        ("policy", 1),
    ],
)
def test_a_kill_inside_a_write_is_survived(name, count, where, program, whole, tmp_path):
    run = tmp_path / "run"
    words = train("tabular", run)
    assert program.run(*words, prepare=partial(die_in_write, name, count, where))[0] == -signal.SIGKILL
    begun = name not in ("options", "config") or (name, where) == ("config", "after")
    code, printed = program.run("resume", str(run))
    assert code == (0 if begun else 2)
    assert begun or printed == f"lodestone: {run} holds no run: there is no config.json.\n"
    assert begun or program.run(*words)[0] == 0
    assert_same(run, whole("tabular"))


def change(**changes: Any) -> Callable[[Path], None]:
    """Changes config.json; None takes a setting away."""

    def make(run: Path) -> None:
        config = json.loads((run / "config.json").read_text()) | changes
        config = {name: value for name, value in config.items() if value is not None or name == "from_run"}
        (run / "config.json").write_text(json.dumps(config))

    return make


def write(name: str, text: str) -> Callable[[Path], None]:
    return lambda run: (run / name).write_text(text) and None


def damage_all(run: Path) -> None:
    for path in checkpoints(run):
        flip(path, 0.5)


def no_lock(run: Path) -> None:
    (run / ".lock").unlink()
    (run / ".lock").mkdir()


AGENT = {"name": "q-learning", "learning_rate": [[0.0, 0.5]], "epsilon": [[0.0, 1.0], [0.7, 0.05]]}
STRANGER = {"id": "antigravity:World-v0", "observation": None, "max_episode_steps": None}
REFUSED = [
    (lambda run: shutil.rmtree(run), "holds no run: there is no config.json."),
    (damage_all, "No checkpoint can be used, so the run cannot go on. The newest: "),
    (no_lock, "cannot be written: Is a directory."),
    (lambda run: (run / "options.safetensors").unlink(), "options.safetensors cannot be read"),
    (lambda run: flip(run / "options.safetensors", 0.0), "options.safetensors is truncated, or no safetensors file."),
    (write("config.json", "{"), "config.json is no JSON file."),
    (write("config.json", "[" * 100_000), "config.json is no JSON file."),
    (write("config.json", "[]"), "config.json is damaged, or from another version than"),
    (change(format=2), "config.json does not fit: its format is 2, and version"),
    (change(format=None), "config.json is damaged, or from another version than"),
    (
        change(agent=AGENT | {"epsilon": [[0.0, 0.5]]}),
        "belongs to another run, or the settings of this one were changed",
    ),
    (change(agent=AGENT | {"epsilon": [[0.0, "0"]]}), "epsilon cannot be '0'."),
    (change(agent=AGENT | {"epsilon": [[0.0, float("nan")]]}), "epsilon cannot be nan."),
    (change(agent=AGENT | {"epsilon": [[0.0, 7.0]]}), "epsilon"),
    (change(agent=AGENT | {"speed": 1}), "no setting of q-learning named 'speed'; there are: learning_rate, epsilon."),
    (change(agent={"name": "dqn"}), "The setting network of dqn is missing."),
    (change(agent=AGENT | {"name": "os.system"}), "no agent named 'os.system'"),
    (change(environment={"name": "moon", "parameters": {}}), "no environment named 'moon'"),
    (change(environment={"name": "chain", "parameters": {}, "more": 1}), "an environment has no 'more'."),
    (change(environment={"name": "gymnasium", "parameters": STRANGER}), "module antigravity, which has to be imported"),
    (change(seeds=[]), "at least one seed"),
    (change(seeds=[10**40]), "seeds is 1000000000"),
    (change(seeds=None), "The setting seeds of a run is missing."),
    (change(steps=True), "steps cannot be True."),
    (change(options=["fly"]), "options.safetensors has other options than config.json names."),
    (change(extra=1), "no setting of a run named 'extra'"),
    (change(from_run="there"), "start.safetensors cannot be read"),
]


@pytest.mark.parametrize(("spoil", "sentence"), REFUSED)
def test_what_cannot_be_resumed_is_refused_in_a_sentence(spoil, sentence, unfinished, capsys, tmp_path):
    run = tmp_path / "run"
    shutil.copytree(unfinished, run)
    spoil(run)
    before = {path: path.read_bytes() for path in run.rglob("*") if path.is_file()}
    assert main(["resume", str(run)]) == 2
    output = capsys.readouterr()
    assert output.out == ""
    sentences = [line for line in output.err.splitlines() if line and "compiling" not in line]
    assert len(sentences) == 1
    assert sentences[0].startswith("lodestone: ")
    assert sentence in sentences[0]
    assert {path: path.read_bytes() for path in run.rglob("*") if path.is_file()} == before


def test_one_process_at_a_time(unfinished, capsys):
    with lock(unfinished / ".lock"):
        assert main(["resume", str(unfinished)]) == 2
    assert capsys.readouterr().err == f"lodestone: Another process is writing in {unfinished}.\n"


def test_an_unfinished_run_is_neither_trained_anew_nor_watched(unfinished, capsys):
    sentence = f"lodestone: {unfinished} holds an unfinished run; `lodestone resume {unfinished}` goes on with it.\n"
    for words in (["train", *WORDS["tabular"], "--out", str(unfinished)], ["watch", str(unfinished)]):
        assert main(words) == 2
        assert capsys.readouterr().err == sentence


def test_a_finished_run_says_so(whole, capsys):
    run = whole("tabular")
    assert main(["resume", str(run)]) == 0
    assert capsys.readouterr().out == f"The run in {run} is finished; `lodestone watch {run}` plays it.\n"
    assert main(["resume", str(run), "--json"]) == 0
    assert json.loads(capsys.readouterr().out) == {"out": str(run), "finished": True}

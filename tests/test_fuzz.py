"""Whatever is typed, and whatever has become of a file: a command does its work, or leaves with exit code 2 after one
sentence and has touched nothing. The work itself is left out here, but what it would begin with is loaded."""

from __future__ import annotations

import dataclasses
import hashlib
import json
import os
import random
import shutil
import signal
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from lodestone.agents import training
from lodestone.agents.training import AGENTS
from lodestone.cli import (
    completion,
    discover,
    doctor,
    main,
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
from lodestone.cli.program import COMMANDS
from lodestone.discovery.catalogue import METHODS
from lodestone.envs.registry import ENVIRONMENTS, environment_class
from lodestone.experiments import magnet_tower
from lodestone.experiments.registry import EXPERIMENTS
from lodestone.files import read_arrays, write_arrays
from lodestone.learning.loop import Algorithm, Chunk
from lodestone.learning.networks import NetworkConfig
from lodestone.options.execution import Rules
from lodestone.report import runs, studies

PATIENCE = 60.0
"""Seconds that a command may take."""


class Reached(BaseException):
    """The work would begin now."""


class Hung(BaseException):
    """A command took too long."""


def reach(*arguments: object, **named: object) -> None:
    raise Reached


@contextmanager
def limited() -> Iterator[None]:
    """Raises `Hung`."""

    def hang(*_: object) -> None:
        raise Hung

    before = signal.signal(signal.SIGALRM, hang)
    signal.setitimer(signal.ITIMER_REAL, PATIENCE)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0)
        signal.signal(signal.SIGALRM, before)


def content(folder: Path) -> dict[str, str]:
    """What every path under a folder is and holds."""
    found = {}
    for path in sorted(folder.rglob("*")):
        kind = "link" if path.is_symlink() else "folder" if path.is_dir() else "file" if path.is_file() else "other"
        data = path.read_bytes() if kind == "file" else b""
        found[str(path.relative_to(folder))] = f"{kind} {hashlib.sha256(data).hexdigest()}"
    return found


def accepted(words: list[str], folder: Path, capsys: pytest.CaptureFixture[str]) -> bool:
    """Whether a command gets to its work. Where it does not, it has said why and `folder` is as it was."""
    before, parsed = content(folder), True
    try:
        with limited():
            code = main(words)
    except Reached:
        code = 0
    except SystemExit as leaving:
        code, parsed = int(leaving.code or 0), False
    except BaseException as error:
        raise AssertionError(f"{words} raised {type(error).__name__}: {error}") from error
    printed = capsys.readouterr()
    assert code in (0, 2), words
    assert "Traceback" not in printed.out + printed.err, words
    if code == 0:
        return True
    assert content(folder) == before, words
    assert printed.out == "", words
    others = ("lodestone: note: ", " ")  # and what says how far the work has got
    sentences = [line for line in printed.err.splitlines() if line and not line.startswith(others)]
    if not parsed:
        assert "--help" in printed.err, words
    else:
        assert len(sentences) == 1, (words, printed.err)
        assert sentences[0].startswith("lodestone: "), words
        assert sentences[0].endswith((".", "?")), (words, printed.err)
    return False


# ---------------------------------------------------------------------------------------------------- command lines

HOSTILE = (
    *("", " ", "-", "--", "nan", "None", "True", "[]", "{}", "½", "é", "\udc80", "a\nb", "%s%n", "x" * 5000),
    *("1_0", "0x10", "1e9", "9" * 30, "1" + "0" * 5000, "/", ".", "~", "*", "$(id)", "../..", "--help", "-h"),
)
INTEGERS = ("-1", "0", "1", "2", "3", "5", "100", "2147483647", "2147483648", "1000000000000", "9" * 19, "9" * 30)
NUMBERS = (*INTEGERS, "nan", "inf", "-inf", "-0.0", "0.5", "0.999", "1e-300", "1e300", "1e400")
PLACES = (
    *(".", "..", "/", "/dev/null", "/dev/full", "/proc/1/x", "/nowhere/a", "\udc80", "y" * 300, "", "-"),
    *("folder", "file", "file/a", "loop", "loop/a", "pipe", "gone", "new", "new/a", "a.gif", "a.png", "a.html"),
    *("a.safetensors", "file.safetensors", "y" * 300 + ".safetensors", "folder/a.safetensors", "loop.safetensors"),
)
PLAN = "plan.toml"
"""A good plan of a sweep."""
NAMES = (*COMMANDS, *AGENTS, *ENVIRONMENTS, *METHODS, *EXPERIMENTS, "CartPole-v1", "os:system", "moon-v0", "lift")
BY_TYPE = {
    "int": INTEGERS,
    "int | None": (*INTEGERS, "None"),
    "float": NUMBERS,
    "float | None": (*NUMBERS, "None"),
    "bool": ("",),
    "tuple[int, ...]": INTEGERS,
    "Knots": NUMBERS,
    "Path": PLACES,
    "Path | None": PLACES,
    "tuple[str, ...]": (*NAMES, *PLACES),
    "Literal": NAMES,
}
NESTED = {"agent": None, "environment": None, "network": NetworkConfig, "rules": Rules, "method_settings": None}


def flags(settings: type) -> list[tuple[str, str]]:
    """Flags and types of a settings class, those inside others too."""
    found = []
    for one in dataclasses.fields(settings):
        if one.name in NESTED:
            inner = NESTED[one.name]
            found += flags(inner) if inner else []
        else:
            found.append((one.name.replace("_", "-"), str(one.type)))
    return found


def command_line(chance: random.Random) -> list[str]:
    """Words that are nearly right."""
    command = chance.choice(tuple(COMMANDS))
    agent, environment, method = (chance.choice(tuple(names)) for names in (AGENTS, ENVIRONMENTS, METHODS))
    world = flags(environment_class(environment))
    words, known = {
        "train": ([agent, environment], flags(AGENTS[agent]) + world + flags(train.Train)),
        "plan": ([environment], world + flags(plan.Plan)),
        "pretrain": ([environment, "--out", "a.safetensors"], world + flags(pretrain.Pretrain)),
        "discover": ([environment, "--method", method], world + flags(METHODS[method]) + flags(discover.Discover)),
        "reproduce": (["--experiment", chance.choice(tuple(EXPERIMENTS))], flags(reproduce.Reproduce)),
        "watch": ([chance.choice(PLACES)], flags(watch.Watch)),
        "resume": ([chance.choice(PLACES)], flags(resume.Resume)),
        "report": (chance.choices(PLACES, k=chance.randint(0, 2)), flags(report.Report)),
        "sweep": ([chance.choice((*PLACES, PLAN, PLAN)), "--out", "new"], flags(sweep.Sweep)),
        "tensorboard": (chance.choices(PLACES, k=chance.randint(0, 2)), flags(tensorboard.TensorBoard)),
        "doctor": ([], flags(doctor.Doctor)),
        "completion": ([chance.choice(("bash", "zsh", "fish", "csh"))], flags(completion.Completion)),
    }[command]
    words = [command, *words]
    for _ in range(chance.randint(0, 3)):
        flag, kind = chance.choice(known)
        values = BY_TYPE.get(kind, HOSTILE) if chance.random() < 0.9 else HOSTILE
        count = 2 * chance.randint(1, 2) if kind == "Knots" else 1 if chance.random() < 0.8 else chance.randint(0, 4)
        words.append(f"--{flag}" if chance.random() < 0.9 else f"--no-{flag}")
        words += [] if kind == "bool" else chance.choices(values, k=count)
    if chance.random() < 0.3:
        at = chance.randrange(len(words) + 1)
        words[at : at + chance.randint(0, 2)] = [chance.choice((*HOSTILE, *NAMES, *PLACES))]
    return words


@pytest.fixture
def places(tmp_path, monkeypatch) -> Path:
    """A current folder in which paths are what they should not be."""
    (tmp_path / "folder" / "a.safetensors").mkdir(parents=True)
    for name in ("file", "file.safetensors"):
        (tmp_path / name).write_text("mine")
    (tmp_path / PLAN).write_text('agent = "q-learning"\nenvironment = "chain"\n[grid]\ndecision-limit = [5, 9]\n')
    for name in ("loop", "loop.safetensors"):
        (tmp_path / name).symlink_to(name)
    (tmp_path / "gone").symlink_to("nowhere")
    os.mkfifo(tmp_path / "pipe")
    monkeypatch.chdir(tmp_path)
    return tmp_path


def rest(monkeypatch: pytest.MonkeyPatch) -> None:
    """From here on no command does its work."""
    for module, name in (
        (training, "train"),
        (pretrain, "pretrain"),
        (magnet_tower, "run"),
        (discover, "discover"),
        (plan, "tabulate"),
        (plan, "optimum"),
        (watch, "record"),
        (doctor, "_look"),
        (sweep, "require_ray"),
        (runs, "play_many"),
        (studies, "save_study"),
    ):
        monkeypatch.setattr(module, name, reach)
    for name, one in EXPERIMENTS.items():
        monkeypatch.setitem(EXPERIMENTS, name, dataclasses.replace(one, run=reach))


@pytest.mark.parametrize("count", [60, pytest.param(500, marks=pytest.mark.slow)])
def test_command_lines(count, places, monkeypatch, capsys):
    rest(monkeypatch)
    chance = random.Random(1)
    outcomes = [accepted(command_line(chance), places, capsys) for _ in range(count)]
    assert 0.02 < np.mean(outcomes) < 0.6


# ------------------------------------------------------------------------------------------------------------ files

ARM = ["magnet-arm", "--rows", "3", "--columns", "3", "--bricks", "2", "--tower-height", "2"]
FLAT = ["--observation", "planes", "--kernels", "--strides", "--channels", "--hidden", "4"]
KINDS = {
    "tables": ["q-learning", "chain"],
    "networks": ["dqn", *ARM, *FLAT, "--options", "go-down", "lift"],
    "united": ["united", *ARM, *FLAT],
    "second": ["united", *ARM, *FLAT, "--from-run", "united"],
    "goals": ["hdqn", "chain", *FLAT],
    "option-critic": ["option-critic", "chain"],
    "deep": ["deep-option-critic", *ARM, *FLAT, "--environments", "2"],
    "plans": ["straw", *ARM, *FLAT, "--environments", "2"],
    "graph": ["maxq", "two-rooms"],
    "machines": ["hamq", *ARM],
    "outside": ["dqn", "CartPole-v1", *FLAT[2:]],
}


def nothing_happens(
    algorithm: Algorithm, seeds: Sequence[int], rounds: int, rounds_per_chunk: int, *start: Any, **named: Any
) -> Iterator[tuple[Any, Chunk]]:
    """`train` up to the first decision, as if two chunks of none had been trained."""
    del rounds_per_chunk, named
    keys = jnp.stack([jax.random.key(seed) for seed in seeds])
    carry = jax.jit(jax.vmap(algorithm.init))(keys, *start)
    _, shapes = jax.eval_shape(jax.vmap(algorithm.run_round, in_axes=(0, None)), carry, jnp.int32(0))
    log = jax.tree.map(lambda leaf: np.zeros((len(seeds), 1, *leaf.shape[1:]), leaf.dtype), shapes)
    for over in (1, rounds):
        yield carry, Chunk(log, over, 0.5 * over)


def make_runs(folder: Path, kinds: Mapping[str, list[str]]) -> None:
    """Runs with nothing learned, finished and (`early-`) not."""
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        patch.setattr(training, "train", nothing_happens)
        patch.setattr(train, "_print_result", lambda *result: None)
        for name, words in kinds.items():
            common = ["--seeds", "2", "--steps", "5000", "--checkpoint-every", "0", "--out", name]
            assert main(["train", *words, *common]) == 0
            shutil.copytree(name, f"early-{name}")
            Path(f"early-{name}/policy.safetensors").unlink()


STRANGE: tuple[Any, ...] = (
    *(None, True, -1, 0, 1, 3, 10**9, 2**31, 10**30, -0.5, 1e308, float("nan"), float("inf")),
    *("", "x", "../../up", "/etc/passwd", "a\0b", "\udc80", "lift", "y" * 300),
    *([], {}, [[]], [0], [[0.0, 1.0]], {"a": 1}),
)


def strange(value: Any, chance: random.Random) -> Any:
    """JSON with something wrong in one place, mostly deep inside."""
    if isinstance(value, dict) and value and chance.random() < 0.9:
        changed, name = dict(value), chance.choice(list(value))
        match chance.randrange(8):
            case 0:
                del changed[name]
            case 1:
                changed[chance.choice(("extra", "", "__class__", "a/b"))] = chance.choice(STRANGE)
            case _:
                changed[name] = strange(value[name], chance)
        return changed
    if isinstance(value, list) and value and chance.random() < 0.7:
        at = chance.randrange(len(value))
        other = chance.choice(([], [strange(value[at], chance)], [value[at]] * 2, [value[at]] * 1000))
        return [*value[:at], *other, *value[at + 1 :]]
    if chance.random() < 0.1:
        return nested(chance.choice((5, 500)))
    return chance.choice(STRANGE)


def nested(depth: int) -> Any:
    return [nested(depth - 1)] if depth else []


def change_json(path: Path, chance: random.Random) -> None:
    """One line of a file that has JSON on every line, or in all of them together."""
    lines = path.read_text().splitlines() if path.suffix == ".jsonl" else [path.read_text()]
    at = chance.randrange(len(lines))
    lines[at] = json.dumps(strange(json.loads(lines[at]), chance))
    path.write_text("\n".join(lines))


def change_header(path: Path, chance: random.Random) -> None:
    """The recipe, what is said of an array, or how long all that is."""
    data = path.read_bytes()
    size = int.from_bytes(data[:8], "little")
    header, body = json.loads(data[8 : 8 + size]), data[8 + size :]
    match chance.randrange(4):
        case 0:
            header = strange(header, chance)
        case 1:
            size = chance.choice((0, 1, size - 1, size + 1, len(data), 10**8, 2**40, 2**63, 2**64 - 1))
            path.write_bytes(size.to_bytes(8, "little") + data[8:])
            return
        case _:
            recipe = strange(json.loads(header["__metadata__"]["lodestone"]), chance)
            header["__metadata__"]["lodestone"] = json.dumps(recipe)
    text = json.dumps(header).encode()
    path.write_bytes(len(text).to_bytes(8, "little") + text + body)


def change_arrays(path: Path, chance: random.Random) -> None:
    """One array is missing, too many, of another shape or type, or holds what it should not."""
    arrays, header = read_arrays(path)
    arrays = arrays or {"options": np.zeros(3, np.float32)}
    name = chance.choice(list(arrays))
    array = arrays.pop(name)
    match chance.randrange(7):
        case 0:
            arrays[chance.choice((f"{name}'", "../../up", "", "y" * 300))] = array
        case 1:
            arrays[name] = array.astype(chance.choice((np.float64, np.int8, np.bool_, np.uint32, np.float16)))
        case 2:
            arrays[name] = array[None]
        case 3:
            arrays[name] = np.concatenate([array, array]) if array.ndim else np.stack([array, array])
        case 4:
            arrays[name] = array.reshape(-1)[:0]
        case 5:
            arrays[name] = array
            array.reshape(-1)[:] = chance.choice((np.nan, np.inf, -np.inf)) if array.dtype.kind == "f" else 1
        case _:
            pass
    write_arrays(path, arrays, header)


def change_bytes(path: Path, chance: random.Random) -> None:
    """As a disk or a transfer would."""
    data = bytearray(path.read_bytes())
    at = chance.randrange(len(data) + 1)
    match chance.randrange(6):
        case 0:
            del data[at:]
        case 1:
            for _ in range(chance.choice((1, 8))):
                data[chance.randrange(len(data))] ^= 1 << chance.randrange(8)
        case 2:
            data[at : at + chance.randint(1, 512)] = bytes(chance.randint(1, 512))
        case 3:
            data[at:at] = chance.randbytes(chance.randint(1, 64))
        case 4:
            data = bytearray(chance.randbytes(len(data)))
        case _:
            data = bytearray(chance.choice((b"", b"\0", b"{}", b"[]", b"null", b"[" * 100_000, b"\xff\xfe", b"\n\n")))
    path.write_bytes(data)


def replace(path: Path, chance: random.Random) -> None:
    """Something else has its name."""
    path.unlink()
    match chance.randrange(5):
        case 0:
            path.mkdir()
        case 1:
            path.symlink_to(path.name)
        case 2:
            path.symlink_to(chance.choice(("nowhere", "/dev/zero", "/dev/null", "/etc/hostname", "/")))
        case 3:
            os.mkfifo(path)
        case _:
            pass


def damage(path: Path, chance: random.Random) -> None:
    """Whatever can become of a file."""
    inside = [change_json] if path.suffix in (".json", ".jsonl") else [change_header, change_header, change_arrays]
    chance.choice((*inside, *inside, *inside, change_bytes, change_bytes, replace))(path, chance)


def case(folder: Path, names: Sequence[str], chance: random.Random) -> tuple[Path, list[str]]:
    """A file of one of these runs, and a command that loads it."""
    name = chance.choice(names)
    resume, report = ["resume", f"early-{name}"], ["report", chance.choice((name, f"early-{name}"))]
    watch, on = ["watch", name, "--html", "a.html"], ["train", *KINDS["united"], "--from-run", name]
    taken = ["train", *KINDS[name], "--options", f"{name}/options.safetensors", "--no-primitives"]
    ways = [
        ("policy.safetensors", chance.choice((watch, watch, ["report", name], on))),
        ("config.json", chance.choice((resume, report))),
        ("options.safetensors", chance.choice((resume, report, taken))),
        ("metrics.jsonl", report),
    ]
    start, checkpoints = folder / f"early-{name}" / "start.safetensors", folder / f"early-{name}" / "checkpoints"
    ways += [("start.safetensors", resume)] * start.exists()
    ways += [(f"checkpoints/{path.name}", resume) for path in checkpoints.glob("*")]
    file, words = chance.choice(ways)
    run = words[1] if words[1].startswith("early-") else name
    return folder / run / file, words


@pytest.mark.parametrize(
    ("count", "kinds"),
    [
        pytest.param(60, ("tables", "networks", "option-critic"), id="few"),
        pytest.param(500, tuple(KINDS), id="many", marks=pytest.mark.slow),
    ],
)
def test_files(count, kinds, tmp_path, monkeypatch, capsys):
    whole = tmp_path / "whole"
    whole.mkdir()
    make_runs(whole, {kind: KINDS[kind] for kind in kinds})
    rest(monkeypatch)
    outcomes = []
    for number in range(count):
        chance = random.Random(f"file {number}")
        file, words = case(whole, kinds, chance)
        here = tmp_path / str(number)
        run = file.relative_to(whole).parts[0]
        shutil.copytree(whole / run, here / run)
        damage(here / file.relative_to(whole), chance)
        monkeypatch.chdir(here)
        outcomes.append(accepted(words, here, capsys))
    assert 0.02 < np.mean(outcomes) < 0.5

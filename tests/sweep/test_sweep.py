"""`lodestone sweep`: every trial is the run that `lodestone train` makes, whatever dies meanwhile."""

from __future__ import annotations

import json
import os
import signal
import socket
import subprocess
import sys
import tempfile
import time
import tomllib
from collections.abc import Callable, Iterator
from importlib.util import find_spec
from pathlib import Path

import numpy as np
import pytest
from processes import Program

from lodestone.agents.run import load_run
from lodestone.cli import main
from lodestone.cli.sweep import Piece
from lodestone.cli.train import parse_train, run_of
from lodestone.errors import InvalidConfig
from lodestone.sweep import running
from lodestone.sweep.plan import corners, plan_of, trials

PLAN = """
agent = "q-learning"
environment = "two-rooms"
seeds = 2
seeds-per-trial = 1
[train]
steps = 2000
checkpoint-every = 0
[random]
draws = {draws}
[random.values]
learning-rate = [[0, {{low = 0.05, high = 1.0, log = true}}]]
"""
FIFTY = PLAN.format(draws=5).replace("seeds = 2", "seeds = 10")
HAS_RAY = find_spec("ray") is not None
needs_ray = pytest.mark.skipif(not HAS_RAY, reason="Ray is not installed")


def written(tmp_path: Path, text: str) -> Path:
    path = tmp_path / "plan.toml"
    path.write_text(text)
    return path


@pytest.mark.skipif(HAS_RAY, reason="Ray is installed")
def test_without_ray_a_sentence_says_how_to_get_it(tmp_path, capsys):
    plan = written(tmp_path, PLAN.format(draws=2))
    assert main(["sweep", str(plan), "--out", str(tmp_path / "out")]) == 2
    assert capsys.readouterr().err == "lodestone: A sweep needs Ray: pip install 'lodestone[cluster]'.\n"
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    ("old", "new", "sentence"),
    [
        ("steps = 2000", "speed = 2000", "speed"),
        ("steps = 2000", "steps = 0", "steps is 0, but must be at least 1."),
        ("high = 1.0", "high = 7.0", "learning_rate"),
        ("q-learning", "magic", "There is no agent named 'magic'"),
    ],
)
def test_a_flag_that_is_refused_is_refused_before_anything_is_written(old, new, sentence, tmp_path, capsys):
    plan = written(tmp_path, PLAN.format(draws=2).replace(old, new))
    try:
        code = main(["sweep", str(plan), "--out", str(tmp_path / "out")])
    except SystemExit as leaving:
        code = leaving.code
    assert code == 2
    assert sentence in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


def test_the_plan_in_the_docs_can_be_trained():
    text = Path(__file__).parents[2].joinpath("docs", "sweeps.md").read_text().split("```toml\n")[1].split("```")[0]
    plan = plan_of(tomllib.loads(text))
    assert len(trials(plan)) == 80
    for trial in corners(plan):
        run_of(parse_train(list(trial.words)))


@pytest.mark.parametrize(
    ("address", "sentence"),
    [
        ("127.0.0.1:1", "No Ray cluster answers at 127.0.0.1:1: Connection refused."),
        ("127.0.0.1:no", "127.0.0.1:no is no address"),
        (f"127.0.0.1:{10**30}", "is no address"),
        ("cluster", "cluster is no address: it has to be like 192.0.2.1:6379, or auto."),
    ],
)
def test_where_no_cluster_answers_nothing_is_written(address, sentence, tmp_path, monkeypatch, capsys):
    monkeypatch.setattr("lodestone.cli.sweep.require_ray", lambda: None)
    out = tmp_path / "out"
    assert main(["sweep", str(written(tmp_path, PLAN.format(draws=2))), "--out", str(out), "--address", address]) == 2
    assert sentence in capsys.readouterr().err
    assert not out.exists()


def here(fail: str | None = None) -> Callable[..., Iterator[tuple[Piece, str | None]]]:
    """In the place of Ray: one trial after the other in this process; the second fails, or is interrupted."""

    def run_all(work, pieces, *settings):
        for number, piece in enumerate(pieces):
            if number == 1 and fail == "interrupt":
                raise KeyboardInterrupt
            yield piece, fail if number == 1 and fail else work(piece)

    return run_all


@pytest.mark.slow
def test_a_sweep_is_interrupted_goes_on_and_names_what_failed(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr("lodestone.cli.sweep.require_ray", lambda: None)
    monkeypatch.chdir(tmp_path)
    text = PLAN.format(draws=1).replace("steps = 2000", "steps = 300").replace("seeds = 2", "seeds = 3")
    words = ["sweep", str(written(tmp_path, text)), "--out", "out"]
    out = tmp_path / "out"

    monkeypatch.setattr("lodestone.cli.sweep.run_all", here("interrupt"))
    assert main(words) == 130
    assert capsys.readouterr().err.endswith(f"interrupted; the same command goes on with the sweep in {out}.\n")
    first = (out / "trials" / "0001" / "policy.safetensors").stat().st_mtime_ns

    monkeypatch.setattr("lodestone.cli.sweep.run_all", here("it fell over."))
    with pytest.raises(SystemExit, match="1"):
        main(words)
    assert "Trial 0003 failed: it fell over.\n" in capsys.readouterr().out

    monkeypatch.setattr("lodestone.cli.sweep.run_all", here())
    assert main([*words, "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert (out / "trials" / "0001" / "policy.safetensors").stat().st_mtime_ns == first
    assert [(row["trial"], row["seed"]) for row in found["rows"]] == [("0001", 0), ("0002", 1), ("0003", 2)]
    assert all(row["gap"] == row["optimal_return"] - row["greedy_return"] for row in found["rows"])
    (standing,) = found["configurations"]
    assert standing["seeds"] == 3
    assert standing["greedy_return"] == pytest.approx(sum(row["greedy_return"] for row in found["rows"]) / 3)
    assert (out / "results.csv").read_text().startswith("trial,learning-rate,seed,steps,")
    assert "learning-rate 0 " in (out / "report.html").read_text()

    (tmp_path / "plan.toml").write_text(text.replace("seeds = 3", "seeds = 2"))
    assert main(words) == 2
    assert "holds a sweep of another plan" in capsys.readouterr().err


@needs_ray
@pytest.mark.slow
def test_a_piece_whose_process_dies_is_begun_again(tmp_path):
    def work(piece: int) -> None:
        tries = tmp_path / str(piece)
        with tries.open("a") as file:
            file.write("x")
        if piece == 5 or (piece == 3 and tries.stat().st_size == 1):
            os.kill(os.getpid(), signal.SIGKILL)
        if piece == 7:
            raise ValueError("It is seven.")

    over = dict(running.run_all(work, range(10), None, 2, 1))
    assert over == {**dict.fromkeys(range(10)), 5: "its process died 2 times.", 7: "ValueError: It is seven."}
    assert [int(path.name) for path in sorted(tmp_path.iterdir()) if path.stat().st_size == 2] == [3, 5]


class Ray:
    """Sweeps in processes of their own, which share the code that they compile with `Program`."""

    def __init__(self, folder: Path, plan: Path, out: Path) -> None:
        self._out = out
        self._words = [sys.executable, "-m", "lodestone.cli", "sweep", str(plan), "--out", str(out), "--json"]
        self._variables = {
            **os.environ,
            "JAX_DISABLE_MOST_OPTIMIZATIONS": "1",
            "JAX_COMPILATION_CACHE_DIR": str(folder / "compiled"),
            "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": "0",
            "JAX_PERSISTENT_CACHE_MIN_ENTRY_SIZE_BYTES": "-1",
        }

    def start(self, *where: str) -> subprocess.Popen[str]:
        return subprocess.Popen(
            [*self._words, *(where or ("--workers", "2"))],
            stdout=subprocess.PIPE,
            text=True,
            env=self._variables,
            start_new_session=True,
        )

    def until(self, finished: int, process: subprocess.Popen[str]) -> None:
        """Wait for so many trials to be over."""
        while process.poll() is None and len(self.results()) < finished:
            time.sleep(0.05)
        assert process.poll() is None

    def results(self) -> dict[Path, int]:
        """When they were written."""
        return {path: path.stat().st_mtime_ns for path in self._out.glob("trials/*/result.json")}


@needs_ray
@pytest.mark.slow
def test_fifty_trials_outlive_an_interruption_and_a_worker(tmp_path):
    program, plan, out = Program(tmp_path), written(tmp_path, FIFTY), tmp_path / "out"
    ray = Ray(tmp_path, plan, out)

    with ray.start() as process:
        ray.until(10, process)
        os.killpg(process.pid, signal.SIGINT)  # as Ctrl-C does
    assert process.returncode == 130
    before = ray.results()
    assert 10 <= len(before) < 50

    with ray.start() as process:
        ray.until(25, process)
        _kill_a_worker(process.pid)
        found = json.loads(process.communicate()[0])
    assert process.returncode == 0
    assert before.items() <= ray.results().items()
    assert (found["trials"], found["failed"], len(found["rows"]), len(found["configurations"])) == (50, {}, 50, 5)
    words = json.loads((out / "sweep.json").read_text())["trials"]
    for first in range(0, 50, 10):  # a configuration's ten seeds, at once and without Ray
        together = tmp_path / str(first)
        assert program.run("train", *words[first][:-1], "10", "--out", str(together))[0] == 0
        trained = [load_run(out / "trials" / f"{first + number:04}") for number in range(1, 11)]
        np.testing.assert_array_equal(
            np.concatenate([policy.learned for policy in trained]), load_run(together).learned
        )

    after = ray.results()
    with ray.start() as process:
        assert json.loads(process.communicate()[0]) == found
    assert ray.results() == after


@needs_ray
@pytest.mark.slow
def test_a_sweep_on_a_cluster_that_was_there_before(tmp_path, monkeypatch):
    """And is there afterwards."""
    monkeypatch.setenv("RAY_AUTH_MODE", "token")
    with socket.create_server(("127.0.0.1", 0)) as free:
        port = free.getsockname()[1]
    plan, out = written(tmp_path, PLAN.format(draws=2)), tmp_path / "out"
    with tempfile.TemporaryDirectory() as short:  # sockets have short names
        words = ["start", "--head", "--block", f"--port={port}", "--num-cpus=2", "--include-dashboard=false"]
        cluster = subprocess.Popen(
            [Path(sys.executable).with_name("ray"), *words, f"--temp-dir={short}"],
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
            start_new_session=True,
        )
        try:
            _wait_for(port, cluster)
            with Ray(tmp_path, plan, out).start("--address", f"127.0.0.1:{port}") as process:
                found = json.loads(process.communicate()[0])
            assert process.returncode == 0
            assert (found["trials"], found["failed"], len(found["rows"])) == (4, {}, 4)
            assert cluster.poll() is None
        finally:
            os.killpg(cluster.pid, signal.SIGTERM)
            cluster.wait(60)


def _wait_for(port: int, cluster: subprocess.Popen) -> None:
    while True:
        assert cluster.poll() is None
        try:
            return running.require_answer(f"127.0.0.1:{port}")
        except InvalidConfig:
            time.sleep(0.2)


def _kill_a_worker(driver: int) -> None:
    """Kill a process of Ray, of this driver's, that is training."""
    for path in Path("/proc").glob("[0-9]*"):
        try:
            training = path.joinpath("cmdline").read_bytes().startswith(b"ray::train_trial")
            if training and _descends(int(path.name), driver):
                os.kill(int(path.name), signal.SIGKILL)
                return
        except OSError:
            continue
    raise AssertionError("no process is training")


def _descends(process: int, ancestor: int) -> bool:
    while process not in (0, 1, ancestor):
        process = int(Path(f"/proc/{process}/stat").read_text().rsplit(")", 1)[1].split()[1])
    return process == ancestor

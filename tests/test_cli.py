"""The command line as a program: what it prints, what it refuses."""

from __future__ import annotations

import dataclasses
import json
from dataclasses import replace
from pathlib import Path

import jax
import numpy as np
import pytest
from fake_study import make_study

from lodestone import __version__
from lodestone.agents.playing import play_many
from lodestone.agents.saved import load_policy
from lodestone.agents.training import AGENTS
from lodestone.cli import main
from lodestone.cli.discover import Discover
from lodestone.cli.train import Train
from lodestone.discovery.catalogue import METHODS
from lodestone.envs.registry import ENVIRONMENTS, environment_class
from lodestone.errors import UnknownName
from lodestone.experiments.registry import EXPERIMENTS, experiment
from lodestone.experiments.study import Experiment, Study
from lodestone.learning.networks import NetworkConfig
from lodestone.learning.progress import Progress
from lodestone.options.base import NO_CAP
from lodestone.options.execution import Rules
from lodestone.options.four_rooms import HALLWAY_OPTIONS

TINY = ["--rows", "3", "--columns", "3", "--bricks", "2", "--tower-height", "2"]
SHAPE = ["--kernels", "3", "--strides", "3", "--channels", "8", "--hidden", "32"]
SMALL = [*SHAPE, "--learning-starts", "100"]
GOALS = ["--reward-scale", "0.2", "--discount", "0.97", "--max-goal-steps", "10"]


def run(capsys: pytest.CaptureFixture[str], *words: str) -> tuple[int, str, str]:
    """Exit code, standard output and standard error."""
    try:
        code = main(words)
    except SystemExit as leaving:
        code = int(leaving.code or 0)
    output = capsys.readouterr()
    return code, output.out, output.err


def test_plan_prints_one_json_object(capsys):
    code, out, _ = run(capsys, "plan", "magnet-arm", "--json", "--options", "go-down", "lift")
    found = json.loads(out)
    assert code == 0
    assert (found["states"], found["optimal_steps"], found["optimal_return"]) == (156, 13, 87)
    assert found["discounted_value"] == pytest.approx(76.39059, abs=1e-4)
    assert found["optimal_decisions"] == 7


def test_plan_takes_an_environments_parameters(capsys):
    code, out, _ = run(capsys, "plan", "four-rooms", "--dynamics", "code", "--json")
    found = json.loads(out)
    assert code == 0
    assert found["parameters"]["dynamics"] == "code"
    assert found["optimal_steps"] == pytest.approx(8.3924, abs=1e-4)


def test_plan_knows_machines_and_subtasks(capsys):
    code, out, _ = run(capsys, "plan", "taxi", "--move-success", "0.8", "--machines", "--subtasks", "--json")
    found = json.loads(out)
    assert code == 0
    assert found["optimal_return"] == pytest.approx(3.954575, abs=1e-6)
    assert found["machines"]["optimal_return"] == pytest.approx(3.954575, abs=1e-6)
    assert found["subtasks"]["recursive_return"] == pytest.approx(3.954575, abs=1e-6)
    assert found["subtasks"]["values_stored"] <= 632
    code, out, _ = run(
        capsys, "plan", "magnet-arm", "--rows", "5", "--bricks", "4", "--tower-height", "4", "--machines"
    )
    assert "24, 8" in out
    assert run(capsys, "plan", "four-rooms", "--machines")[0] == 2


def test_plan_prints_a_table(capsys):
    code, out, _ = run(capsys, "plan", "magnet-arm", *TINY)
    assert code == 0
    assert "optimal steps" in out


@pytest.fixture(scope="module")
def trained(tmp_path_factory) -> Path:
    """A short run with options."""
    folder = tmp_path_factory.mktemp("runs") / "run"
    words = ["train", "dqn", "magnet-arm", *TINY, *SMALL, "--steps", "900", "--seeds", "2", "--seed", "7"]
    assert main([*words, "--options", "go-down", "lift", "--out", str(folder)]) == 0
    return folder


def test_train_leaves_a_run_folder(trained):
    config = json.loads((trained / "config.json").read_text())
    assert config["seeds"] == [7, 8]
    assert config["environment"]["parameters"]["rows"] == 3
    lines = [json.loads(line) for line in (trained / "metrics.jsonl").read_text().splitlines()]
    assert {line["seed"] for line in lines} == {7, 8}
    last = lines[-1]
    assert last["steps"] >= 900
    assert sum(last["calls"].values()) > 0
    assert config["versions"]["jax"] == jax.__version__
    files = [".lock", "config.json", "metrics.jsonl", "options.safetensors", "policy.safetensors"]
    assert sorted(path.name for path in trained.iterdir()) == files


def test_watch_plays_in_a_pipe_and_writes_pictures(trained, capsys, tmp_path):
    code, out, _ = run(capsys, "watch", str(trained))
    assert code == 0
    assert "step   1:" in out
    code, out, _ = run(capsys, "watch", str(trained), "--position", "1", "--gif", str(tmp_path / "new" / "a.gif"))
    assert code == 0
    assert (tmp_path / "new" / "a.gif").read_bytes()[:3] == b"GIF"
    code, out, _ = run(capsys, "watch", str(trained / "policy.safetensors"), "--html", str(tmp_path / "a.html"))
    assert code == 0
    assert "<html" in (tmp_path / "a.html").read_text()


def test_train_prints_json_and_writes_nothing_without_out(capsys, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    code, out, _ = run(capsys, "train", "q-learning", "magnet-arm", *TINY, "--steps", "3000", "--seed", "3", "--json")
    found = json.loads(out)
    assert code == 0
    assert found["seeds"][0]["seed"] == 3
    assert found["seeds"][0]["steps"] >= 2900
    assert found["optimal_return"] > 0
    assert list(tmp_path.iterdir()) == []


def test_plan_knows_the_hallways(capsys):
    """Of the 103 cells to begin in, the 52 of the two eastern rooms and their western hallways are one hallway away
    from the goal in the east, the other 51 are two."""
    words = ["plan", "four-rooms", "--dynamics", "deterministic", "--json", "--options"]
    code, out, _ = run(capsys, *words, "hallways")
    found = json.loads(out)
    assert code == 0
    assert found["optimal_decisions"] == pytest.approx((52 + 2 * 51) / 103)
    code, out, _ = run(capsys, *words, "south-east-to-east", "north-east-to-east")
    assert found["optimal_decisions"] < json.loads(out)["optimal_decisions"] < found["optimal_steps"]


@pytest.mark.parametrize("agent", ["q-learning", "intra-option"])
def test_hallway_options_are_trained_with_saved_and_watched(agent, capsys, tmp_path):
    words = ["train", agent, "four-rooms", "--dynamics", "deterministic", "--options", "hallways", "--seeds", "2"]
    code, out, _ = run(capsys, *words, "--steps", "60000", "--out", str(tmp_path / "run"), "--json")
    found = json.loads(out)
    assert code == 0
    assert [row["success"] for row in found["seeds"]] == [1.0, 1.0]
    policy = load_policy(tmp_path / "run" / "policy.safetensors")
    assert policy.agent == agent
    assert policy.options.names[4:] == HALLWAY_OPTIONS
    assert policy.options.max_steps == (1,) * 4 + (NO_CAP,) * 8
    again = play_many(policy, jax.random.key(0), found["greedy_episodes"])
    assert again.steps.mean(axis=1).tolist() == [row["greedy_steps"] for row in found["seeds"]]
    code, out, _ = run(capsys, "watch", str(tmp_path / "run"))
    assert code == 0
    assert "step   1:" in out


def test_scripts_are_capped_unless_the_agent_learns_within_options(capsys, tmp_path):
    for agent, cap in (("q-learning", 21), ("intra-option", NO_CAP)):
        words = ["train", agent, "magnet-arm", *TINY, "--options", "lift", "--steps", "1000"]
        assert run(capsys, *words, "--out", str(tmp_path / agent))[0] == 0
        assert load_policy(tmp_path / agent / "policy.safetensors").options.max_steps[-1] == cap


@pytest.fixture
def invented(monkeypatch: pytest.MonkeyPatch) -> Experiment:
    """An experiment that is known for the time of a test."""

    def find(seeds: int, progress: Progress) -> Study:
        progress.begin("inventing", 1.0)
        progress.advance(1.0, "done")
        return replace(make_study(20), seeds=seeds)

    one = Experiment("fake", "An invented study", seeds=20, work=1.0, run=find)
    monkeypatch.setitem(EXPERIMENTS, one.name, one)
    return one


def test_an_experiment_is_found_by_its_name(invented):
    assert experiment("fake") is invented
    with pytest.raises(UnknownName, match=r"no experiment named 'moon'; there are: .*fake"):
        experiment("moon")


def test_experiments_are_listed(invented, capsys, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    code, out, _ = run(capsys, "reproduce", "--list")
    assert code == 0
    lines = out.splitlines()
    assert lines[0].startswith("magnet-tower ")
    assert lines[-1].split(maxsplit=1) == ["fake", "An invented study (20 seeds)"]
    assert len(lines) == 1 + len(EXPERIMENTS)
    code, out, _ = run(capsys, "reproduce", "--list", "--json")
    rows = json.loads(out)
    assert [row["name"] for row in rows] == ["magnet-tower", *EXPERIMENTS]
    assert rows[-1] == {"name": "fake", "title": "An invented study", "seeds": 20}
    assert list(tmp_path.iterdir()) == []


def test_an_experiment_is_reproduced(invented, capsys, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    code, out, _ = run(capsys, "reproduce", "--experiment", "fake")
    assert code == 0  # also where a gate is missed
    assert sorted(path.name for path in (tmp_path / "out" / "fake").iterdir()) == [
        "fake-1.svg",
        "fake.png",
        "report.html",
        "results.json",
    ]
    for expected in ("What must come out", "MISSED", "Learners", "14,000", "report.html", "results.json"):
        assert expected in out
    found = json.loads((tmp_path / "out" / "fake" / "results.json").read_text())
    assert found["settings"]["command"] == "lodestone reproduce --experiment fake --seeds 20 --out out/fake"


def test_an_experiment_prints_its_results_as_json(invented, capsys, tmp_path):
    words = ["reproduce", "--experiment", "fake", "--seeds", "4", "--out", str(tmp_path / "new"), "--json"]
    code, out, _ = run(capsys, *words)
    found = json.loads(out)
    assert code == 0
    assert found == json.loads((tmp_path / "new" / "results.json").read_text())
    assert found["seeds"] == 4
    assert [gate["passed"] for gate in found["gates"]] == [True, True, False, False]


def test_an_interrupted_experiment_leaves_no_files(invented, capsys, tmp_path, monkeypatch):
    def interrupted(seeds: int, progress: Progress) -> Study:
        raise KeyboardInterrupt

    monkeypatch.setitem(EXPERIMENTS, "fake", replace(invented, run=interrupted))
    code, out, err = run(capsys, "reproduce", "--experiment", "fake", "--out", str(tmp_path / "new"))
    assert (code, out) == (130, "")
    assert "interrupted" in err
    assert [path for path in tmp_path.rglob("*") if path.is_file()] == []


@pytest.mark.parametrize("choice", [["--figure", "2"], ["--preset", "paper"]])
def test_choices_of_the_towers_are_refused_elsewhere(choice, invented, capsys, tmp_path):
    words = ["reproduce", "--experiment", "fake", *choice, "--out", str(tmp_path / "new")]
    code, out, err = run(capsys, *words)
    assert (code, out) == (2, "")
    assert err == f"lodestone: {choice[0]} belongs to magnet-tower; fake has no such choice.\n"
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("agent", "environment", "steps"),
    [
        ("maxq", ["taxi", "--step-limit", "200", "--discount", "1"], "40000"),
        ("maxq", ["two-rooms"], "30000"),
        ("hamq", ["magnet-arm", *TINY], "20000"),
        ("hamq", ["taxi", "--step-limit", "200", "--discount", "1"], "150000"),
        ("united", ["magnet-arm", *TINY, *SMALL, "--hidden", "64"], "40000"),
        ("hdqn", ["magnet-arm", *TINY, *SMALL, *GOALS], "20000"),
        ("option-critic", ["four-rooms", "--step-limit", "1000"], "30000"),
        ("deep-option-critic", ["magnet-arm", *TINY, *SHAPE, "--reward-scale", "0.2"], "80000"),
        ("sarsa", ["four-rooms", "--dynamics", "deterministic"], "60000"),
    ],
)
def test_hierarchies_are_trained_saved_and_watched(agent, environment, steps, capsys, tmp_path):
    run_folder = str(tmp_path / "run")
    code, out, _ = run(
        capsys, "train", agent, *environment, "--steps", steps, "--seeds", "2", "--json", "--out", run_folder
    )
    found = json.loads(out)
    assert code == 0
    assert all(row["success"] > 0.9 for row in found["seeds"])
    # The last choice is not over; a united network spends a tick on every new episode.
    assert all(row["steps"] + row["episodes"] >= 0.95 * int(steps) for row in found["seeds"])
    policy = load_policy(tmp_path / "run" / "policy.safetensors")
    again = play_many(policy, jax.random.key(0), found["greedy_episodes"])
    assert again.total_reward.mean(axis=1).tolist() == [row["greedy_return"] for row in found["seeds"]]
    code, out, _ = run(capsys, "watch", run_folder, "--html", str(tmp_path / "a.html"), "--delay", "0")
    assert code == 0
    assert "NaN" not in (tmp_path / "a.html").read_text()


REFUSED = [
    (["nonsense"], "no command named 'nonsense'"),
    (["plan"], "needs the name of an environment"),
    (["plan", "moon"], "no environment named 'moon'"),
    (["train", "reinforce", "magnet-arm"], "no agent named 'reinforce'"),
    (["train", "dqn"], "needs the name of an environment"),
    (["plan", "magnet-arm", "--bricks", "99"], "99 bricks do not fit"),
    (["plan", "magnet-arm", "--tower-height", "4"], "allow a tower of at most"),
    (["plan", "magnet-arm", "--rows", "0"], "rows is 0"),
    (["plan", "magnet-arm", "--columns", "-2"], "columns is -2"),
    (["plan", "magnet-arm", "--discount", "1.5"], "discount is 1.5"),
    (["plan", "magnet-arm", "--options", "fly"], "no option named 'fly'"),
    (["train", "dqn", "magnet-arm", "--learning-rate", "0", "nan"], "learning_rate"),
    (["train", "dqn", "magnet-arm", "--learning-rate", "0", "inf"], "learning_rate"),
    (["train", "dqn", "magnet-arm", "--options", "fly"], "no option named 'fly'"),
    (["train", "dqn", "taxi", "--options", "fly"], "no option named 'fly'; there are none here"),
    (["plan", "four-rooms", "--options", "fly"], "no option named 'fly'; there are: hallways, north-west-to-north,"),
    (["train", "q-learning", "four-rooms", "--options", "hallways", "south-east-to-east"], "need different names"),
    (["train", "dqn", "magnet-arm", "--options", "lift", "--option-cap", "0"], "step cap is 0"),
    (["train", "intra-option", "magnet-arm", "--options", "lift", "--option-cap", "9"], "stopped after 9 steps"),
    (["train", "intra-option", "magnet-arm", "--call-cost", "0.5"], "call_cost is 0.5"),
    (["plan", "four-rooms", "--goal", "104"], "goal is 104"),
    (["plan", "chain", "--length", "10001"], "length is 10001"),
    (["plan", "magnet-arm", "--columns", "1001"], "columns is 1001"),
    (["plan", "magnet-arm", "--tower-reward", "1e39"], "tower_reward is 1e+39, but may be at most 3.4e+38"),
    (["plan", "random-mdp", "--states", "5000"], "states is 5000"),
    (["plan", "corridor-maze", "--length", "10000"], "1000000 squares"),
    (["train", "dqn", "chain", "--steps", "9" * 20], "but may be at most 2147483647"),
    (["train", "dqn", "chain", "--seeds", "100001"], "at most 100000"),
    (["watch", "y" * 300], "File name too long"),
    (["train", "dqn", "magnet-arm", "--options", "missing.safetensors"], "missing.safetensors"),
    (["train", "maxq", "magnet-arm", "--out", "run"], "no ready-made task graph for magnet-arm"),
    (["train", "hamq", "chain", "--out", "run"], "no ready-made machines for chain"),
    (["train", "hamq", "magnet-arm", "--options", "lift"], "takes no options"),
    (["train", "united", "magnet-arm", "--options", "lift"], "takes no options"),
    (["train", "option-critic", "four-rooms", "--options", "hallways"], "takes no options"),
    (["train", "option-critic", "four-rooms", "--call-cost", "0.5"], "call_cost is 0.5"),
    (["train", "option-critic", "four-rooms", "--temperature", "0"], "temperature is 0"),
    (["train", "united", "taxi"], "this environment has none"),
    (["train", "deep-option-critic", "taxi", "--options", "fly"], "no option named 'fly'"),
    (["train", "deep-option-critic", "four-rooms", "--decay", "2"], "decay is 2"),
    (["train", "deep-option-critic", "four-rooms", "--no-bootstrap-at-limit"], "bootstrap_at_limit is False"),
    (["train", "hdqn", "taxi", "--out", "run"], "chooses among goals, and this environment has none"),
    (["train", "hdqn", "magnet-arm", "--options", "lift"], "takes no options"),
    (["train", "hdqn", "chain", "--success-window", "3"], "success_window must hold"),
    (["train", "straw", "goal-maze", "--horizon", "0"], "horizon is 0"),
    (["train", "straw", "goal-maze", "--call-cost", "1"], "call_cost is 1"),
    (["train", "straw", "magnet-arm", "--options", "lift"], "takes no options"),
    (["train", "united", "magnet-arm", "--option-cap", "5"], "option_cap is given, but no options are"),
    (["train", "united", "magnet-arm", "--from-run", "nowhere", "--out", "run"], "nowhere"),
    (["train", "united", "magnet-arm", "--training", "manager", "--out", "run"], "needs a trained network to start"),
    (["train", "dqn", "magnet-arm", "--steps", "0"], "steps is 0"),
    (["train", "dqn", "magnet-arm", "--seeds", "0"], "seeds is 0"),
    (["train", "dqn", "magnet-arm", "--no-primitives"], "at least one option"),
    (["train", "dqn", "magnet-arm", "--no-primitives", "--options", "lift"], "No option may start"),
    (["reproduce", "--preset", "slow"], "slow"),
    (["reproduce", "--figure", "4"], "4"),
    (["reproduce", "--seeds", "0"], "seeds is 0"),
    (["reproduce", "--experiment", "moon"], "no experiment named 'moon'; there are: magnet-tower"),
    (["watch", "nowhere"], "nowhere"),
]


@pytest.mark.parametrize(("words", "sentence"), REFUSED)
def test_bad_input_is_refused_in_a_sentence(words, sentence, capsys, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    code, out, err = run(capsys, *words)
    assert code == 2
    assert sentence in " ".join(err.replace("│", " ").split())
    assert "Traceback" not in err
    assert out == ""
    assert list(tmp_path.rglob("*")) == []


@pytest.mark.slow
def test_a_united_network_starts_as_another_ended_on_another_grid(capsys, tmp_path):
    shape = ["--observation", "planes", "--kernels", "3", "--strides", "1", "--channels", "8", "--hidden", "16"]
    short = ["--learning-starts", "100", "--steps", "400", "--json"]
    words = ["train", "united", "magnet-arm", *shape, *short]
    first, second = tmp_path / "first", tmp_path / "second"
    assert run(capsys, *words, "--pooling", *TINY, "--out", str(first))[0] == 0
    larger = [*words, "--from-run", str(first), "--training", "manager", "--seeds", "2", "--out", str(second)]
    code, _, err = run(capsys, *larger)
    assert (code, err.count("\n")) == (2, 1)
    assert "have to be the same" in err
    assert not second.exists()
    assert run(capsys, *larger, "--pooling")[0] == 0
    assert json.loads((second / "config.json").read_text())["from_run"] == str(first)
    old, new = (load_policy(folder / "policy.safetensors").networks.trunk for folder in (first, second))
    for was, stays in zip(jax.tree.leaves(old), jax.tree.leaves(new), strict=True):
        np.testing.assert_array_equal(stays, np.repeat(was, 2, axis=0))


def flags(settings: type) -> list[str]:
    """Names of a settings class, those inside others too."""
    inner = {"network": NetworkConfig, "rules": Rules}
    names = [field.name for field in dataclasses.fields(settings)]
    return [one for name in names for one in (flags(inner[name]) if name in inner else [name])]


@pytest.mark.parametrize(
    ("command", "part"),
    [*((Train, kind) for kind in AGENTS.values()), *((Discover, kind) for kind in METHODS.values())],
)
@pytest.mark.parametrize("environment", list(ENVIRONMENTS))
def test_no_two_settings_have_one_name(command, part, environment):
    names = [*flags(command), *flags(part), *flags(environment_class(environment))]
    assert sorted(set(names)) == sorted(names)


def test_an_output_folder_that_cannot_be_written_is_refused(capsys, tmp_path):
    (tmp_path / "file").write_text("mine")
    for words in (["train", "dqn", "magnet-arm"], ["reproduce"]):
        code, _, err = run(capsys, *words, "--out", str(tmp_path / "file" / "run"))
        assert code == 2
        assert "cannot be written" in err
    assert (tmp_path / "file").read_text() == "mine"


def test_a_run_is_not_overwritten(trained, capsys):
    before = (trained / "config.json").read_bytes()
    code, _, err = run(capsys, "train", "dqn", "magnet-arm", "--out", str(trained))
    assert code == 2
    assert "holds a run already" in err
    assert (trained / "config.json").read_bytes() == before


def test_help_and_version(capsys):
    code, out, _ = run(capsys)
    assert code == 0
    assert "reproduce" in out
    assert run(capsys, "--version")[1] == f"lodestone {__version__}\n"
    code, out, _ = run(capsys, "train", "dqn", "magnet-arm", "--help")
    assert code == 0
    assert "--tower-height" in out


def test_the_doctor_says_what_is_here(capsys):
    code, out, _ = run(capsys, "doctor", "--json")
    found = json.loads(out)
    assert code == 0
    assert found["packages"]["jax"] == jax.__version__
    assert len(found["devices"]) == jax.device_count()
    code, out, _ = run(capsys, "doctor")
    assert code == 0
    assert "devices" in out

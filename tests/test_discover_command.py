"""`lodestone discover`: what it prints, saves and draws, and what it refuses."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from PIL import Image

from lodestone.agents.saved import load_options
from lodestone.cli import main
from lodestone.discovery.catalogue import METHODS
from lodestone.envs.four_rooms import FourRooms

HOUSE = ["four-rooms", "--dynamics", "deterministic"]
ARM = ["magnet-arm", "--rows", "3", "--columns", "3", "--bricks", "2", "--tower-height", "2"]


def run(capsys: pytest.CaptureFixture[str], *words: str) -> tuple[int, str, str]:
    """Exit code, standard output and standard error."""
    try:
        code = main(["discover", *words])
    except SystemExit as leaving:
        code = int(leaving.code or 0)
    output = capsys.readouterr()
    return code, output.out, output.err


def found(capsys: pytest.CaptureFixture[str], *words: str) -> dict:
    """The JSON object."""
    code, out, _ = run(capsys, *words, "--json")
    assert code == 0
    return json.loads(out)


def test_betweenness_of_the_four_rooms(capsys):
    content = found(capsys, *HOUSE, "--method", "betweenness")
    assert [tuple(square) for square in content["subgoals"]] == [
        (3, 7),
        (3, 5),
        (6, 9),
        (8, 9),
        (5, 2),
        (7, 2),
        (10, 7),
        (10, 5),
    ]
    assert [round(one["betweenness"], 4) for one in content["options"]][:2] == [0.2901, 0.2860]
    assert [one["initiation_states"] for one in content["options"]] == [103] * 8
    assert (content["states"], content["states_seen"], content["steps_recorded"]) == (104, 104, 0)
    assert content["environment"]["parameters"]["dynamics"] == "deterministic"
    near = found(capsys, *HOUSE, "--method=betweenness", "--number", "2", "--nearest", "20")
    assert [one["initiation_states"] for one in near["options"]] == [20, 20]


def test_eigenoptions_of_the_four_rooms(capsys):
    content = found(capsys, *HOUSE, "--number", "32", "--method", "eigenoptions")
    assert content["diffusion_time_of_primitives"] == pytest.approx(620.77, abs=0.005)
    assert content["diffusion_time"] == pytest.approx(234.31, abs=0.005)
    assert content["eigenvalues"][:2] == pytest.approx([0.00701, 0.00850], abs=5e-6)
    assert {tuple(square) for square in content["subgoals"][:2]} == {(10, 2), (2, 10)}
    assert len(content["subgoals"]) == len(content["options"]) == 32


def test_covering_of_the_four_rooms(capsys):
    content = found(capsys, *HOUSE, "--method", "covering")
    assert content["lambda_2"] == pytest.approx([0.0229, 0.02714, 0.05079, 0.05465, 0.06464], abs=1e-4)
    assert {tuple(end) for end in content["pairs"][0]} == {(1, 11), (11, 1)}
    assert content["pairs"][0] == [content["subgoals"][1], content["subgoals"][0]]


def test_diverse_density_from_trajectories(capsys):
    words = ["--method", "diverse-density", "--from", "trajectories", "--trajectories", "50", "--steps", "400"]
    content = found(capsys, *HOUSE, *words, "--threshold", "1")
    assert 0 < content["successful_trajectories"] <= 50
    assert 0 < content["steps_recorded"] <= 20_000
    assert content["options"][0]["log_density"] < 0
    assert len(content["subgoals"]) == 1


def test_options_are_saved_for_train(capsys, tmp_path):
    file = tmp_path / "new" / "options.safetensors"
    words = ["--method", "eigenoptions", "--number", "4", "--from", "trajectories", "--steps", "100", "--seed", "3"]
    content = found(capsys, *ARM, *words, "--out", str(file))
    assert content["subgoals"][0].startswith("bricks=[")
    assert content["states_seen"] <= content["states"] == 54
    assert content["steps_recorded"] == 10_000
    code = main(
        ["train", "q-learning", *ARM, "--options", str(file), "--steps", "2000", "--out", str(tmp_path / "run")]
    )
    assert code == 0
    config = json.loads((tmp_path / "run" / "config.json").read_text())
    assert config["options"][6:] == ["eigen-1-up", "eigen-1-down", "eigen-2-up", "eigen-2-down"]


@pytest.mark.parametrize("method", METHODS)
def test_a_table_and_a_picture(method, capsys, tmp_path):
    words = [*HOUSE, "--method", method, "--out", str(tmp_path / "a.safetensors")]
    code, out, _ = run(capsys, *words, "--picture", str(tmp_path / "a.png"))
    assert code == 0
    for part in (f"{method} on four-rooms", "goes to", "Diffusion time: 620.77 steps", "a.png", "lodestone train"):
        assert part in " ".join(out.split())
    picture = Image.open(tmp_path / "a.png")
    assert picture.width > 400
    assert len(set(picture.convert("RGB").get_flattened_data())) > 20
    assert load_options(tmp_path / "a.safetensors", FourRooms("deterministic")).size >= 1


REFUSED = [
    ([], "needs the name of an environment"),
    (HOUSE, "needs --method and one of: diverse-density, betweenness, eigenoptions, covering"),
    ([*HOUSE, "--method"], "needs --method"),
    ([*HOUSE, "--method", "moon"], "no method named 'moon'"),
    (["moon", "--method", "covering"], "no environment named 'moon'"),
    ([*HOUSE, "--method", "covering", "--number", "0"], "number is 0"),
    ([*HOUSE, "--method", "eigenoptions", "--number", "3"], "come in pairs"),
    ([*HOUSE, "--method", "eigenoptions", "--number", "400"], "400 options need 200 eigenvectors"),
    ([*HOUSE, "--method", "betweenness", "--number", "-1"], "number is -1"),
    ([*HOUSE, "--method", "betweenness", "--initiation", "point"], "--initiation"),
    ([*HOUSE, "--method", "diverse-density", "--steps", "1", "--trajectories", "1"], "None of 1 trajectories"),
    ([*HOUSE, "--method", "covering", "--from", "trajectories", "--trajectories", "2", "--steps", "3"], "pieces"),
    ([*HOUSE, "--method", "covering", "--from", "moon"], "moon"),
    ([*HOUSE, "--method", "covering", "--trajectories", "0"], "trajectories is 0"),
    ([*ARM, "--method", "covering", "--picture", "a.png"], "squares of a grid"),
]


@pytest.mark.parametrize(("words", "sentence"), REFUSED)
def test_bad_input_is_refused_in_a_sentence(words, sentence, capsys, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    code, out, err = run(capsys, *words)
    assert code == 2
    assert sentence in " ".join(err.replace("│", " ").split())
    assert "Traceback" not in err
    assert out == ""
    assert list(Path().rglob("*")) == []


def test_help_names_the_settings_of_the_method(capsys):
    code, out, _ = run(capsys, *HOUSE, "--method", "covering", "--help")
    assert code == 0
    assert "--initiation" in out
    assert "--from" in out
    assert "--goal" in out

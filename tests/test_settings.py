"""Settings out of JSON: what was written comes back, and nothing else gets in."""

from __future__ import annotations

import json
from dataclasses import dataclass
from typing import Literal

import pytest

from lodestone.agents.training import AGENTS
from lodestone.envs.registry import ENVIRONMENTS
from lodestone.errors import InvalidConfig, LodestoneError
from lodestone.files import json_safe
from lodestone.options.execution import Rules
from lodestone.settings import from_json


@dataclass(frozen=True)
class Inner:
    pairs: tuple[tuple[float, int], ...] = ((0.5, 1), (2.0, 3))


@dataclass(frozen=True)
class Outer:
    inner: Inner
    name: str = "x"
    flag: bool = False
    limit: int | None = None
    word: Literal["a", "b"] = "a"


GOOD = {"inner": {"pairs": [[1, 2]]}, "name": "n", "flag": True, "limit": 3, "word": "b"}


def test_values_come_back_with_their_types():
    found = from_json(Outer, GOOD, "it")
    assert found == Outer(Inner(((1.0, 2),)), "n", True, 3, "b")
    assert isinstance(found.inner.pairs[0][0], float)
    assert from_json(Outer, GOOD | {"limit": None}, "it").limit is None


@pytest.mark.parametrize("kind", [*AGENTS.values(), *ENVIRONMENTS.values(), Rules])
def test_all_settings_there_are_come_back(kind):
    text = json.dumps(json_safe(kind()))
    assert from_json(kind, json.loads(text), "it") == kind()


@pytest.mark.parametrize(
    ("changes", "sentence"),
    [
        ({"name": 1}, "name cannot be 1"),
        ({"flag": 1}, "flag cannot be 1"),
        ({"limit": True}, "limit cannot be True"),
        ({"limit": 1.0}, "limit cannot be 1.0"),
        ({"word": "c"}, "word cannot be 'c'"),
        ({"word": ["a"]}, "word cannot be"),
        ({"inner": None}, "inner cannot be None"),
        ({"inner": {"pairs": [[1, 2, 3]]}}, "pairs cannot be"),
        ({"inner": {"pairs": [[1, 2.5]]}}, "pairs cannot be 2.5"),
        ({"inner": {"pairs": [[10**400, 2]]}}, "pairs cannot be 1000"),
        ({"inner": {"pairs": [[float("inf"), 2]]}}, "pairs cannot be inf"),
        ({"inner": {"pairs": [["1", 2]]}}, "pairs cannot be '1'"),
        ({"inner": {"pairs": "ab"}}, "pairs cannot be 'ab'"),
        ({"inner": {}}, "The setting pairs of inner is missing"),
        ({"more": 1}, "no setting of it named 'more'; there are: inner, name"),
    ],
)
def test_anything_else_is_refused(changes, sentence):
    with pytest.raises(LodestoneError, match=sentence.replace("(", r"\(")):
        from_json(Outer, GOOD | changes, "it")


def test_values_are_checked_by_their_class():
    with pytest.raises(InvalidConfig, match="discount is 7"):
        from_json(Rules, json_safe(Rules()) | {"discount": 7.0}, "rules")

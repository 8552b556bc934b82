"""Every method, from tables and from trajectories, gives options that every agent takes and that files hold."""

from __future__ import annotations

import jax
import numpy as np
import pytest
from house import HOUSE

from lodestone.agents.dqn import DQNConfig
from lodestone.agents.intra_option import IntraOptionConfig
from lodestone.agents.q_learning import QLearningConfig
from lodestone.agents.saved import load_options, save_options
from lodestone.agents.training import train_policy
from lodestone.discovery.catalogue import METHODS, diffusion_times, discover
from lodestone.discovery.experience import Recording
from lodestone.discovery.squares import squares_of
from lodestone.envs.corridor_maze import CorridorMaze
from lodestone.envs.four_rooms import FourRooms
from lodestone.envs.magnet_arm import MagnetArm
from lodestone.envs.state_space import reachable_states
from lodestone.envs.two_rooms import TwoRooms
from lodestone.learning.networks import NetworkConfig
from lodestone.options.base import Primitives, Union
from lodestone.options.execution import Rules
from lodestone.planning.option_models import option_models, option_value_iteration, tabulate_options
from lodestone.planning.solve import value_iteration
from lodestone.planning.tables import tabulate

ARM = MagnetArm(rows=4, columns=3, bricks=3, tower_height=3)


@pytest.mark.parametrize("source", ["tables", "trajectories"])
@pytest.mark.parametrize("dynamics", ["deterministic", "sps"])
@pytest.mark.parametrize("method", METHODS)
def test_options_of_the_house_run_and_end(method: str, dynamics: str, source: str) -> None:
    """Where an option may start it runs at least one step, surely stops, and goes on only where it may start."""
    rooms = FourRooms(dynamics)
    found = discover(rooms, METHODS[method](number=4), source, Recording(60, 200))
    tables = tabulate(rooms)
    options = tabulate_options(found.options, tables.space)
    assert 1 <= options.size <= 4
    assert options.initiation.any(axis=1).all()
    assert found.steps == 0 if source == "tables" and method != "diverse-density" else 0 < found.steps <= 12_000
    steps = tables.with_step_reward(-1.0)
    for option, model in enumerate(option_models(steps, options, 1.0)):
        starts = options.initiation[option] & ~tables.terminal
        assert (model.rewards[starts] <= -1).all()
        assert np.isfinite(model.rewards[starts]).all()
        if method != "covering":
            assert not (options.initiation[option] & (options.termination[option] == 1)).any()


@pytest.mark.parametrize("method", METHODS)
def test_options_change_no_optimum(method: str) -> None:
    found = discover(HOUSE, METHODS[method](number=4), "trajectories", Recording(60, 200))
    tables = tabulate(HOUSE)
    together = tabulate_options(Union((Primitives(HOUSE.action_names), found.options)), tables.space)
    solution = option_value_iteration(tables, together, 0.9)
    np.testing.assert_allclose(solution.values, value_iteration(tables, 0.9).values, atol=1e-8)


def test_only_what_was_seen_is_used() -> None:
    """A short walk in the arm's world: nothing starts in a state that it never was in."""
    recording = Recording(2, 50)
    for method in ("betweenness", "eigenoptions", "covering"):
        found = discover(ARM, METHODS[method](number=2), "trajectories", recording)
        assert found.steps == 100
        assert found.seen < 60
        starts = np.asarray(found.options.initiation_table).any(axis=1)
        assert starts.sum() < found.seen
        assert found.options.space.size == reachable_states(ARM).size == 156


@pytest.mark.parametrize("method", ["betweenness", "eigenoptions", "covering"])
def test_options_are_saved_and_loaded(method: str, tmp_path) -> None:
    found = discover(ARM, METHODS[method](number=4))
    save_options(tmp_path / "options.safetensors", found.options, ARM)
    again = load_options(tmp_path / "options.safetensors", ARM)
    one, other = (tabulate_options(options, reachable_states(ARM)) for options in (found.options, again))
    for mine, loaded in zip(one, other, strict=True):
        np.testing.assert_array_equal(mine, loaded)


@pytest.mark.parametrize(
    "config",
    [
        QLearningConfig(),
        IntraOptionConfig(),
        DQNConfig(network=NetworkConfig((3,), (3,), (4,), (16,)), learning_starts=50, environments=2),
    ],
)
def test_every_agent_takes_them(config) -> None:
    parts = [discover(ARM, METHODS[method](number=2)).options for method in ("betweenness", "eigenoptions", "covering")]
    options = Union((Primitives(ARM.action_names), *parts))
    policy, history = train_policy(config, ARM, options, Rules(decision_limit=50), 1000, [0])
    calls = sum(usage.calls for usage in history.usage)
    assert (calls[0, 6:] > 0).sum() >= 4
    assert jax.tree.leaves(policy.learned)


def test_diffusion_times_of_the_house() -> None:
    alone, together = diffusion_times(HOUSE, discover(HOUSE, METHODS["eigenoptions"](number=32)).options)
    assert alone == pytest.approx(620.77, abs=0.005)
    assert together == pytest.approx(234.31, abs=0.005)


def test_squares_are_where_the_pictures_show_the_agent() -> None:
    """Neighbouring states are on neighbouring squares."""
    for environment in (HOUSE, TwoRooms(), CorridorMaze(1, 2, move_success=1.0)):
        tables = tabulate(environment)
        squares = squares_of(environment, tables.space)
        assert squares is not None
        assert len(np.unique(squares, axis=0)) == tables.num_states
        far = np.abs(squares[tables.successors[:, :, 0]] - squares[:, None]).sum(axis=-1)
        assert far.max() == 1
    assert squares_of(ARM, reachable_states(ARM)) is None

"""The names that most programs on top of Lodestone need, in one place."""

from lodestone.agents.deep_option_critic import DeepOptionCriticConfig
from lodestone.agents.dqn import DQNConfig
from lodestone.agents.hamq import HAMQConfig
from lodestone.agents.hdqn import HDQNConfig
from lodestone.agents.intra_option import IntraOptionConfig
from lodestone.agents.maxq import MAXQConfig
from lodestone.agents.option_critic import OptionCriticConfig
from lodestone.agents.playing import Playback, play, record
from lodestone.agents.policies import GoalPolicy, MachinePolicy, OptionCriticPolicy, PlanPolicy, Policy, UnitedPolicy
from lodestone.agents.pretraining import as_options, pretrain
from lodestone.agents.q_learning import QLearningConfig
from lodestone.agents.sarsa import SarsaConfig
from lodestone.agents.saved import load_options, load_policy, save_options, save_policy
from lodestone.agents.straw import StrawConfig
from lodestone.agents.training import train_policy
from lodestone.agents.united import UnitedConfig
from lodestone.devices import use_all_cores
from lodestone.discovery.betweenness import BetweennessConfig
from lodestone.discovery.catalogue import discover
from lodestone.discovery.covering import CoveringConfig
from lodestone.discovery.diverse_density import DiverseDensityConfig
from lodestone.discovery.eigenoptions import EigenoptionsConfig
from lodestone.discovery.experience import Recording
from lodestone.envs.base import Environment
from lodestone.envs.chain import Chain
from lodestone.envs.corridor_maze import CorridorMaze
from lodestone.envs.four_rooms import FourRooms
from lodestone.envs.goal_maze import GoalMaze
from lodestone.envs.host import FromFunction, Registered
from lodestone.envs.magnet_arm import MagnetArm, go_down_task, lift_task
from lodestone.envs.option_env import HostOption, OptionEnv
from lodestone.envs.random_mdp import RandomMDP
from lodestone.envs.task import Task, goal, looks
from lodestone.envs.taxi import Taxi
from lodestone.envs.two_rooms import TwoRooms
from lodestone.errors import LodestoneError
from lodestone.learning.checkpoints import Checkpoints
from lodestone.learning.networks import NetworkConfig
from lodestone.learning.plan_network import PlanConfig
from lodestone.machines.machine import Hierarchy, Machine, every_action
from lodestone.options.base import Capped, Options, Primitives, Union, primitives
from lodestone.options.catalogue import named_options, scripted_options
from lodestone.options.execution import Rules
from lodestone.options.four_rooms import hallway_options
from lodestone.options.scripted import Script, Scripted
from lodestone.options.subgoals import Subgoal, subgoal_options
from lodestone.planning.interruption import Interrupting
from lodestone.planning.joint import hierarchical_optimum
from lodestone.planning.solve import optimum
from lodestone.subtasks.task_graph import Child, Subtask, TaskGraph

__all__ = [
    "BetweennessConfig",
    "Capped",
    "Chain",
    "Checkpoints",
    "Child",
    "CorridorMaze",
    "CoveringConfig",
    "DQNConfig",
    "DeepOptionCriticConfig",
    "DiverseDensityConfig",
    "EigenoptionsConfig",
    "Environment",
    "FourRooms",
    "FromFunction",
    "GoalMaze",
    "GoalPolicy",
    "HAMQConfig",
    "HDQNConfig",
    "Hierarchy",
    "HostOption",
    "Interrupting",
    "IntraOptionConfig",
    "LodestoneError",
    "MAXQConfig",
    "Machine",
    "MachinePolicy",
    "MagnetArm",
    "NetworkConfig",
    "OptionCriticConfig",
    "OptionCriticPolicy",
    "OptionEnv",
    "Options",
    "PlanConfig",
    "PlanPolicy",
    "Playback",
    "Policy",
    "Primitives",
    "QLearningConfig",
    "RandomMDP",
    "Recording",
    "Registered",
    "Rules",
    "SarsaConfig",
    "Script",
    "Scripted",
    "StrawConfig",
    "Subgoal",
    "Subtask",
    "Task",
    "TaskGraph",
    "Taxi",
    "TwoRooms",
    "Union",
    "UnitedConfig",
    "UnitedPolicy",
    "as_options",
    "discover",
    "every_action",
    "go_down_task",
    "goal",
    "hallway_options",
    "hierarchical_optimum",
    "lift_task",
    "load_options",
    "load_policy",
    "looks",
    "named_options",
    "optimum",
    "play",
    "pretrain",
    "primitives",
    "record",
    "save_options",
    "save_policy",
    "scripted_options",
    "subgoal_options",
    "train_policy",
    "use_all_cores",
]

"""PPO of skrl on short goals."""

import torch  # pyright: ignore[reportMissingImports]
from skrl.agents.torch.ppo import PPO, PPO_CFG  # pyright: ignore[reportMissingImports]
from skrl.memories.torch import RandomMemory  # pyright: ignore[reportMissingImports]
from skrl.models.torch import DeterministicMixin, GaussianMixin, Model  # pyright: ignore[reportMissingImports]
from skrl.trainers.torch import SequentialTrainer  # pyright: ignore[reportMissingImports]
from torch import nn  # pyright: ignore[reportMissingImports]

import interactive_nav
from interactive_nav.interop.skrl_env import SkrlEnv
from interactive_nav.interop.torch_bridge import TorchVectorEnv


def mlp(inputs: int, outputs: int) -> nn.Sequential:
    """Return a network of two hidden layers."""
    return nn.Sequential(nn.Linear(inputs, 64), nn.ELU(), nn.Linear(64, 64), nn.ELU(), nn.Linear(64, outputs))


class Actor(GaussianMixin, Model):
    """Mean actions, and one standard deviation for each of them."""

    def __init__(self, **spaces):
        Model.__init__(self, **spaces)
        GaussianMixin.__init__(self, clip_actions=False)
        self.net = mlp(self.num_observations, self.num_actions)
        self.log_std = nn.Parameter(torch.full((self.num_actions,), -0.5))

    def compute(self, inputs, role=""):
        return self.net(inputs["observations"]), {"log_std": self.log_std}


class Critic(DeterministicMixin, Model):
    """The value of an observation."""

    def __init__(self, **spaces):
        Model.__init__(self, **spaces)
        DeterministicMixin.__init__(self)
        self.net = mlp(self.num_observations, 1)

    def compute(self, inputs, role=""):
        return self.net(inputs["observations"]), {}


def train(envs: TorchVectorEnv, iterations: int, directory: str = "skrl_run") -> PPO:
    """Return the agent after as many iterations of 32 steps in every environment."""
    env, config = SkrlEnv(envs), PPO_CFG(rollouts=32, learning_epochs=4, mini_batches=4, time_limit_bootstrap=True)
    config.experiment.directory = directory
    spaces = {"observation_space": env.observation_space, "action_space": env.action_space, "device": env.device}
    models = {"policy": Actor(**spaces).to(env.device), "value": Critic(**spaces).to(env.device)}
    memory = RandomMemory(memory_size=32, num_envs=env.num_envs, device=env.device)
    agent = PPO(models=models, memory=memory, cfg=config, **spaces)
    options = {"timesteps": 32 * iterations, "headless": True, "close_environment_at_exit": False}
    SequentialTrainer(env=env, agents=agent, cfg=options).train()
    return agent


if __name__ == "__main__":
    flat = interactive_nav.make("turtlebot", ["scenes_mjcf/apartment_0"], episode_steps=400, max_goal_distance_m=4.0)
    train(TorchVectorEnv(flat, num_envs=64, final_obs=False), 200)

"""PPO of rsl_rl on short goals."""

from rsl_rl.runners import OnPolicyRunner  # pyright: ignore[reportMissingImports]

import interactive_nav
from interactive_nav.interop.rsl_rl_env import RslRlVecEnv
from interactive_nav.interop.torch_bridge import TorchVectorEnv

NETWORK = {"class_name": "MLPModel", "hidden_dims": [64, 64], "activation": "elu", "obs_normalization": False}
CONFIG = {
    "num_steps_per_env": 32,
    "save_interval": 50,
    "obs_groups": {"actor": ["policy"], "critic": ["policy"]},
    "actor": NETWORK | {"distribution_cfg": {"class_name": "GaussianDistribution", "init_std": 0.6}},
    "critic": NETWORK,
    "algorithm": {
        "class_name": "PPO",
        "num_learning_epochs": 4,
        "num_mini_batches": 4,
        "learning_rate": 1e-3,
        "entropy_coef": 0.0,
        "schedule": "fixed",
    },
}


def train(envs: TorchVectorEnv, iterations: int, log_dir: str | None = None) -> OnPolicyRunner:
    """Return the runner after as many iterations of 32 steps in every environment."""
    runner = OnPolicyRunner(RslRlVecEnv(envs), CONFIG, log_dir, str(envs.device))
    runner.learn(iterations)
    return runner


if __name__ == "__main__":
    env = interactive_nav.make("turtlebot", ["scenes_mjcf/apartment_0"], episode_steps=400, max_goal_distance_m=4.0)
    train(TorchVectorEnv(env, num_envs=64, final_obs=False), 200, "rsl_rl_run")

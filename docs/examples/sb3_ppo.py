"""PPO of Stable-Baselines3 on short goals; prints means over the last 100 training episodes now and then."""

import time

import numpy as np
import torch  # pyright: ignore[reportMissingImports]
from stable_baselines3 import PPO  # pyright: ignore[reportMissingImports]
from stable_baselines3.common.callbacks import BaseCallback  # pyright: ignore[reportMissingImports]

import interactive_nav
from interactive_nav.interop.sb3_env import SB3VecEnv
from interactive_nav.interop.torch_bridge import TorchVectorEnv


class Scores(BaseCallback):
    """Collects the scores of finished episodes."""

    def __init__(self, every: int = 20_000):
        super().__init__()
        self.every, self.next, self.began = every, every, time.monotonic()
        self.rows: list[tuple[float, float, float]] = []

    def _on_step(self) -> bool:
        for info in self.locals["infos"]:
            if "episode" in info:
                self.rows.append((info["success"], info["ins_0.5"], info["episode"]["r"]))
        if self.num_timesteps >= self.next and self.rows:
            self.next += self.every
            success, ins, total = np.mean(self.rows[-100:], 0)
            print(
                f"{self.num_timesteps} steps, {time.monotonic() - self.began:.0f} s: "
                f"success {success:.2f}, INS_0.5 {ins:.3f}, return {total:.1f}",
                flush=True,
            )
        return True


def train(envs: TorchVectorEnv, total_steps: int, **settings) -> PPO:
    """Return the model after this many steps of all environments together."""
    model = PPO("MlpPolicy", SB3VecEnv(envs), batch_size=256, n_epochs=5, seed=0, device="cpu", **settings)
    return model.learn(total_steps, callback=Scores())


if __name__ == "__main__":
    torch.set_num_threads(1)  # networks this small gain nothing from more, and the simulation uses the others
    env = interactive_nav.make("turtlebot", ["scenes_mjcf/apartment_0"], episode_steps=400, max_goal_distance_m=4.0)
    train(TorchVectorEnv(env, num_envs=32), 100_000, n_steps=64, ent_coef=0.002).save("sb3_ppo")

"""PPO in one file, in the style of CleanRL: nothing leaves the device on which the simulation runs."""

import torch  # pyright: ignore[reportMissingImports]
from torch import nn  # pyright: ignore[reportMissingImports]

import interactive_nav
from interactive_nav.interop.torch_bridge import TorchVectorEnv


def mlp(inputs: int, outputs: int) -> nn.Sequential:
    """Return a network of two hidden layers."""
    return nn.Sequential(nn.Linear(inputs, 64), nn.Tanh(), nn.Linear(64, 64), nn.Tanh(), nn.Linear(64, outputs))


def train(envs: TorchVectorEnv, iterations: int, steps: int = 32, gamma: float = 0.99, lam: float = 0.95) -> nn.Module:
    """Return the network of mean actions after as many iterations of `steps` in every environment."""
    obs = envs.reset(seed=0)
    actor, critic = mlp(obs.shape[1], envs.num_actions).to(obs.device), mlp(obs.shape[1], 1).to(obs.device)
    log_std = nn.Parameter(torch.full((envs.num_actions,), -0.5, device=obs.device))
    parameters = [*actor.parameters(), *critic.parameters(), log_std]
    optimizer = torch.optim.Adam(parameters, 1e-3)
    for iteration in range(iterations):
        rows, scores = [], []
        with torch.no_grad():
            for _ in range(steps):
                policy = torch.distributions.Normal(actor(obs), log_std.exp())
                action, value = policy.sample(), critic(obs)[:, 0]
                new, reward, terminated, truncated, info = envs.step(action)
                if info:  # a time limit is no end: what would have followed is worth its value
                    reward = reward + gamma * truncated * critic(info["final_obs"])[:, 0]
                    scores.append(info["episode"]["success"].clone())
                log = policy.log_prob(action).sum(-1)
                rows.append((obs.clone(), action, log, value, reward.clone(), terminated | truncated))
                obs = new
            advantage, next_value, returns = torch.zeros_like(reward), critic(obs)[:, 0], []
            for _, _, _, value, reward, done in reversed(rows):
                advantage = reward + ~done * gamma * (next_value + lam * advantage) - value
                next_value = value
                returns.append(advantage)
        advantages = torch.cat(returns[::-1])
        b_obs, b_action, b_log, b_value = (torch.cat(part) for part in list(zip(*rows, strict=True))[:4])
        for _ in range(4):
            for index in torch.randperm(len(b_obs), device=obs.device).chunk(4):
                policy = torch.distributions.Normal(actor(b_obs[index]), log_std.exp())
                ratio = (policy.log_prob(b_action[index]).sum(-1) - b_log[index]).exp()
                gain = (advantages[index] - advantages[index].mean()) / (advantages[index].std() + 1e-8)
                error = critic(b_obs[index])[:, 0] - (advantages + b_value)[index]
                loss = -torch.min(ratio * gain, ratio.clamp(0.8, 1.2) * gain).mean() + 0.5 * error.square().mean()
                optimizer.zero_grad()
                loss.backward()
                nn.utils.clip_grad_norm_(parameters, 0.5)
                optimizer.step()
        if scores:
            print(f"{(iteration + 1) * len(b_obs)} steps: success {torch.stack(scores).mean():.2f}", flush=True)
    return actor


if __name__ == "__main__":
    env = interactive_nav.make("turtlebot", ["scenes_mjcf/apartment_0"], episode_steps=400, max_goal_distance_m=4.0)
    torch.save(train(TorchVectorEnv(env, num_envs=64), 200), "cleanrl_ppo.pt")

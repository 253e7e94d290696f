"""Train policies in environments by PPO, SAC and DDPG."""

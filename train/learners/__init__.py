"""PPO, SAC and DDPG: environments in, policies out."""

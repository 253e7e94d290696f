"""Score policies as rows of episodes."""

LEARNED = "learned"
POLICIES = (LEARNED, "random", "follower")
"""The policy of a run, and baselines of `policies.make_baseline`."""
PLANNERS = ("avoider", "namo:W", "puller")
SEED = 1_000_000
"""Of the fixed episodes where none is given."""
AUTO_BATCH = {"native": 4096, "jax": 1024, "warp": 4096}
"""Episodes played at a time, per physics backend."""

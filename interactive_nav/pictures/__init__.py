"""Draw pictures and replays of episodes for people."""

"""What a person sees: pictures and replays of episodes."""

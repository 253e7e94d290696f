"""Play episodes with navigators, and score their rows."""

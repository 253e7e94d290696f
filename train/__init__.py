"""Env + typed config -> trained policies, scored episodes and figures."""

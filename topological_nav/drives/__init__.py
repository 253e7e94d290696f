"""The expert's drives, and the local policy that learns from them."""

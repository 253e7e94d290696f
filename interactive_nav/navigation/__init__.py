"""Where a robot can go: tables built once, looked up inside jit."""

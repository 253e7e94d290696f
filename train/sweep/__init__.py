"""Train many runs from one file: what to run (`spec`), how far each is (`folder`), what to do next (`scheduler`)."""

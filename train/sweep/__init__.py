"""Train many runs from one file: what to run (`spec`), how far each is (`folder`), where there is room
(`devices`), what to do next (`scheduler`), and what a person sees (`table`)."""

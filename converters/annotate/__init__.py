"""A scan annotated by a person in the browser: which CAD model stands where."""

"""Let a person annotate a scan in the browser: which CAD model stands where."""

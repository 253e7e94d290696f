"""One-off studies behind numbers of the documentation: programs to run in a checkout, not part of the package."""

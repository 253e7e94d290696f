"""Scene folders (MJCF, maps, assets) and the schema that every reader and writer of one shares."""

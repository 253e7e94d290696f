"""Export networks and maps, and choose those that come with the package."""

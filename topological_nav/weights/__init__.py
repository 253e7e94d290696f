"""Networks and maps that come with the package."""

"""Weather and forecast files: the services' formats, and this project's own."""

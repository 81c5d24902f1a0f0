"""Files of weather and of forecasts: the services' formats, and this project's own."""

"""Files of weather and of forecasts: the services' own forms, and this project's."""

"""Weather records: formats, evapotranspiration, and what they are tick by tick."""

"""Weather records: files, evapotranspiration, and values for every tick."""

"""Weather records: their files, their evapotranspiration, and their values for every tick."""

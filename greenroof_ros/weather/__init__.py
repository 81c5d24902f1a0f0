"""Weather records: formats, evapotranspiration, and values tick by tick."""

"""A drive and a site that are not there, on Modbus, and all that can go wrong with them."""

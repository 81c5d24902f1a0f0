"""Simulated drives, relays, sensors and forecast service, with every fault they can develop."""

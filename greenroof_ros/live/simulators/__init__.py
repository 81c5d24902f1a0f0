"""Simulators of the devices at a live site: drives, relays and sensors."""

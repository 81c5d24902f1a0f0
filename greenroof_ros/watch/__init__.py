"""Web page, MQTT bridge and short text summary that show operators the state of a running graph."""

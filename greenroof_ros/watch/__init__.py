"""Web page, MQTT bridge and short text summary that show people the state of a running graph."""

"""Shows people what a running graph does: on a page, over MQTT and in a few lines of text."""

"""The topics, conditions, states and alarms of ``msg_defs/``, as Python objects."""

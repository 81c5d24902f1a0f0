"""One module for each command except ``run`` and ``live``, which are in ``bringup``."""

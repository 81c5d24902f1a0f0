"""One module for each command of ``greenroof``; ``run`` and ``live`` are in ``bringup``."""

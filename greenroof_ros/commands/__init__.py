"""One module for each command of ``greenroof``; ``bringup`` has ``greenroof run``."""

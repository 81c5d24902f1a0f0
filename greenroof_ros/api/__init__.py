"""The Python interface (``import greenroof_ros as gr``) to simulations, charts and environments."""

"""The Python interface, ``import greenroof_ros as gr``: simulations, charts, environments."""

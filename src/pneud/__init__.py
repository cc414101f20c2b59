"""A real-time controller for pneumatic servo axes on a CAN bus."""

__version__ = "0.1.0"

"""The axis and the plant in simulated time."""

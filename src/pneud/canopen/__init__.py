"""CANopen: nodes that have to be configured before anything is armed, and what their words mean."""

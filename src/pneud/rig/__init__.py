"""The software rig: cylinder, valve, sensors and their nodes on the bus."""

"""Faults injected on purpose: what they do to plant, bus and machine, and the verdict on the reaction."""

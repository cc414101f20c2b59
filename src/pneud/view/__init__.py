"""An axis as it runs, for those who look on: the screen of a terminal, and viewers."""

"""The machine that pneud runs on: what it can do in real time, and how pneud is installed on it."""

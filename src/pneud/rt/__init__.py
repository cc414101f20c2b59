"""The real-time side of the machine: pacing, scheduling, systemd notification."""

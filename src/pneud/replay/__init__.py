"""Records without a rig: simulated time, replay and comparison of logs, import and export."""

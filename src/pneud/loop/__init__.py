"""The running loop: pacing, waiting for answers, the exchange around the cycle, what a run comes to."""

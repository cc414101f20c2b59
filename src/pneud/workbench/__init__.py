"""What a log is good for besides being replayed to the bit: what-if, comparison, playing it on a bus."""

"""The record on its way: from the loop through the ring to the recorder."""

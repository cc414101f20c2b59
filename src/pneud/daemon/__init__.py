"""The daemon: what a run needs before anything is forked, its crew around the loop, what it comes to."""

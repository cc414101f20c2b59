"""pneud as a library: logs and simulated runs as one holds them in a notebook, and a client of the daemon."""

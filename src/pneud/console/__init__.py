"""The operator's console: a Unix socket of line-delimited JSON, served by a process beside the loop."""

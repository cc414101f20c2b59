"""Logs as files: writing, rotation, retention, reading, recovery."""
